"""candump's record of an interface, as the judge: an independent program wrote down what was on the wire."""

import itertools
import re
import subprocess
import time
from pathlib import Path
from types import TracebackType

import can

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.legs import Leg
from trade_hil_sim import LogEntry, frames

__all__ = ["Candump", "RecordedLeg", "cansend"]

_LINE = re.compile(r"\((?P<t>[0-9.]+)\) \S+ (?P<id>[0-9A-F]+)#(?P<remote>R?)(?P<data>[0-9A-F]*)")
_MARK = 0x7FE
"""An id that no device has: frames of it say how far the record goes."""
_FUNCTIONS = {
    0x180: "tpdo1",
    0x200: "rpdo1",
    0x280: "tpdo2",
    0x300: "rpdo2",
    0x400: "rpdo3",
    0x580: "sdo_reply",
    0x600: "sdo_request",
    0x700: "heartbeat",
}
"""By identifier, less the node (CiA 301, 7.3.5)."""


def cansend(interface: str, *written: str) -> None:
    """Have cansend send frames, written as ``181#2706``; raises CalledProcessError."""
    script = " && ".join(f"cansend {interface} '{frame}'" for frame in written)
    subprocess.run(["sh", "-c", script], check=True, timeout=PATIENCE_S)


class Candump:
    """candump, recording an interface into a file."""

    def __init__(self, interface: str, file: Path) -> None:
        self._ahead_s = time.time() - time.monotonic()
        with file.open("wb") as out:
            self._process = subprocess.Popen(["candump", "-D", "-L", interface], stdout=out, stdin=subprocess.DEVNULL)
        wait_until(lambda: _is_heard(interface), "candump listens")
        self._file = file.open()
        self._lines: list[str] = []
        self._half = ""
        self._marks = itertools.count()
        self._marker = can.Bus(interface="socketcan", channel=interface)

    def begin(self) -> None:
        """Forget what was recorded so far."""
        self.entries()
        self._lines.clear()

    def entries(self) -> list[LogEntry]:
        """All frames since then, those of the last moment included."""
        data = next(self._marks).to_bytes(4, "big")
        self._marker.send(can.Message(arbitration_id=_MARK, data=data, is_extended_id=False))
        wait_until(lambda: self._read_to(f" {_MARK:03X}#{data.hex().upper()}\n"), "candump has it all")
        return [self._entry(line) for line in self._lines]

    def _read_to(self, mark: str) -> bool:
        """Read on; whether that mark was reached."""
        while line := self._file.readline():
            self._half += line
            if not line.endswith("\n"):
                return False
            line, self._half = self._half, ""
            if line.endswith(mark):
                return True
            self._lines.append(line)
        return False

    def _entry(self, line: str) -> LogEntry:
        found = _LINE.match(line)
        assert found, line
        can_id, t = int(found["id"], 16), float(found["t"]) - self._ahead_s
        name, node = _meaning(can_id, found["data"]) if len(found["id"]) == 3 and not found["remote"] else ("", None)
        return LogEntry(t=t, bus="candump", kind="frame", name=name, device_id=node, hex=found["data"], can_id=can_id)

    def __enter__(self) -> "Candump":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._marker.shutdown()
        self._process.kill()
        self._process.wait(PATIENCE_S)
        self._file.close()


class RecordedLeg(Leg):
    """A leg whose frames are those that candump has recorded; what a shaft did only the simulator knows."""

    candump: Candump

    def frames(self, name: str | None = None, device_id: int | None = None, since: float = 0.0) -> list[LogEntry]:
        return frames(self.candump.entries(), name, device_id=device_id, since=since)


def _meaning(can_id: int, data: str) -> tuple[str, int | None]:
    node, function = can_id & 0x7F, can_id & ~0x7F
    if can_id == 0x000:
        return "nmt", int(data[2:4], 16) or None
    if function == 0x080:
        return ("emcy", node) if node else ("sync", None)
    if function == 0x700 and data == "00":
        return "boot_up", node
    return _FUNCTIONS.get(function, ""), node


def _is_heard(interface: str) -> bool:
    """Whether a program listens to all frames there."""
    return any(interface in line.split() for line in Path("/proc/net/can/rcvlist_all").read_text().splitlines())
