"""A simulator in a process of its own, as tests and demos use it."""

import contextlib
import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from trade_hil_sim.control._client import SimControl
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import LogEntry
from trade_hil_sim.log._queries import read_log
from trade_hil_sim.robot._bus_thread import ready

_PREFIX: Final = "trade-sim-"
_OWNER: Final = "_owner.pid"
READY_S: Final = 30.0
"""How long a simulator may take to start; a busy machine needs seconds to import."""
END_S: Final = 5.0


def _own_folder() -> tuple[Path, BinaryIO]:
    """A new folder, and an open file whose lock shows that its owner is alive: the lock ends with the process."""
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
    sign = (folder / _OWNER).with_suffix(".new").open("wb")
    fcntl.flock(sign, fcntl.LOCK_EX)
    sign.write(f"{os.getpid()}\n".encode())
    sign.flush()
    (folder / _OWNER).with_suffix(".new").rename(folder / _OWNER)  # now it is locked, others may look
    return folder, sign


def remove_leftovers() -> list[Path]:
    """Remove the temporary folders of this user's simulators whose owner was killed; returns them."""
    removed: list[Path] = []
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # another user's, or another kind of folder, or its owner is alive
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            with (folder / _OWNER).open("rb") as sign:
                fcntl.flock(sign, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
                removed.append(folder)
    return removed


class Ready(msgspec.Struct, frozen=True):
    """The one line a simulator prints when all its ports can be opened."""

    ready: bool
    ports: dict[str, str]
    log: str | None
    control: str


class SimProcess:
    """Simulates the buses of a robot file in a process of its own, which ends with this one at the latest.

    Args:
        robot_file: which robot.
        buses: only these; default: all.
        log: file for the byte log; default: one that `close` removes.
        logged: False writes no log: it grows by about 100 kB a second.
        directory: of ports and control socket; default: a temporary one that `close` removes.
        paced: take the time of the real wires.
        ready_s: how long it may take to start, in seconds.

    Raises:
        SimulationError: it did not start; includes its output.
    """

    def __init__(
        self,
        robot_file: Path | str,
        *,
        buses: Sequence[str] = (),
        log: Path | None = None,
        logged: bool = True,
        directory: Path | None = None,
        paced: bool = True,
        ready_s: float = READY_S,
    ) -> None:
        self._own, self._sign = _own_folder()
        self._control: SimControl | None = None
        where = directory or self._own
        command = [sys.executable, "-m", "trade_hil_sim", str(robot_file), "--dir", str(where)]
        command += [
            "--control",
            str(self._own / "_control"),
            *(["--log", str(log or self._own / "_log.jsonl")] if logged else []),
        ]
        command += ["--parent", str(os.getpid()), *(["--unpaced"] if not paced else [])]
        command += [word for bus in buses for word in ("--bus", bus)]
        with (self._own / "_stderr").open("wb") as complaints:
            self._process = subprocess.Popen(  # noqa: S603  # our own module
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=complaints,
                start_new_session=True,  # Ctrl-C is for the driver: it needs its devices to shut them down in order
            )
        try:
            self._ready = self._wait_ready(ready_s)
            self._control = SimControl(self._ready.control)
        except BaseException:
            self.close()
            raise

    @property
    def ports(self) -> dict[str, str]:
        """The port to open for each bus."""
        return dict(self._ready.ports)

    @property
    def log_path(self) -> Path:
        """The path of the byte log. Raises SimulationError if there is none."""
        if self._ready.log is None:
            raise SimulationError("this simulator writes no log; start it with logged=True")
        return Path(self._ready.log)

    @property
    def control(self) -> SimControl:
        """Injects faults into the simulator and carries out orders."""
        if self._control is None:
            raise SimulationError("the simulator has been closed")
        return self._control

    @property
    def control_path(self) -> Path:
        """The control socket, for a `SimControl` of another process."""
        return Path(self._ready.control)

    @property
    def running(self) -> bool:
        """Whether it is still running."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def entries(self) -> list[LogEntry]:
        """The byte log so far."""
        return read_log(self.log_path)

    def kill(self) -> None:
        """Kill it at once, like a power cut of its computer; links stay behind until `close`."""
        self._process.kill()
        self._process.wait(END_S)

    def close(self) -> None:
        """End it and remove its files, including the log unless one was named. Idempotent."""
        if self._control is not None:
            self._control.close()
            self._control = None
        self._end()
        if self._process.stdout is not None:
            self._process.stdout.close()
        shutil.rmtree(self._own, ignore_errors=True)
        self._sign.close()

    def __enter__(self) -> "SimProcess":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _end(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.kill()

    def _wait_ready(self, ready_s: float) -> Ready:
        line = self._first_line(time.monotonic() + ready_s)
        if not line.endswith(b"\n"):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.5)
            output = (self._own / "_stderr").read_text(errors="replace").strip()
            state = "ended" if self._process.poll() is not None else f"was not ready after {ready_s:g} s"
            raise SimulationError(f"the simulator {state}: {output or 'it said nothing'}")
        return msgspec.json.decode(line, type=Ready)

    def _first_line(self, deadline: float) -> bytes:
        if self._process.stdout is None:
            return b""
        fd, line = self._process.stdout.fileno(), b""
        while b"\n" not in line:
            data = os.read(fd, 4096) if ready([fd], timeout_s=deadline - time.monotonic()) else b""
            if not data:
                return line
            line += data
        return line
