"""A simulator in threads of this process, as tests on virtual time use it."""

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path

import msgspec

from trade_hil_sim.control._client import SimControl
from trade_hil_sim.control._server import Answer, ControlServer, State
from trade_hil_sim.faults._commands import Command, SimulationError
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.robot._robot import buses_of
from trade_robotfile import load


class _DirectControl(SimControl):
    """A client that asks the server's object, without a socket."""

    def __init__(self, server: ControlServer) -> None:
        self._server = server

    def close(self) -> None:
        """There is no connection to end."""

    def _ask(self, command: Command | State) -> Answer:
        answer = self._server.answer(msgspec.json.encode(command))
        if answer.error is not None:
            raise SimulationError(answer.error)
        return answer


class SimThreads:
    """Simulates the buses of a robot file in threads of this process, until `close`.

    On a real clock, they share the interpreter with the driver and are late: use `SimProcess` there.

    Args:
        robot_file: which robot.
        log: file for the byte log, which `close` writes; default: it is kept in memory only.
        paced: take the time of the real wires.

    Raises:
        RobotFileError: the file is wrong.
        SimulationError: the devices cannot be simulated.
    """

    def __init__(self, robot_file: Path | str, *, log: Path | None = None, paced: bool = False) -> None:
        self.running = True
        """Whether it is still running."""
        with ExitStack() as undo:
            folder = Path(tempfile.mkdtemp(prefix="trade-sim-threads-"))
            undo.callback(shutil.rmtree, folder, ignore_errors=True)
            self._log, self._file = ByteLog(), log
            undo.callback(self._write)
            buses = buses_of(load(robot_file), folder, log=self._log, paced=paced)
            for bus in buses:
                undo.callback(bus.close)
                bus.open()
            self.ports = {bus.name: str(bus.port) for bus in buses}
            """The port to open for each bus."""
            self.control: SimControl = _DirectControl(ControlServer(folder / "_control", buses))
            """Injects faults into the simulator and carries out orders."""
            self._undo = undo.pop_all()

    @property
    def log_path(self) -> Path:
        """The path of the byte log. Raises SimulationError if there is none."""
        if self._file is None:
            raise SimulationError("this simulator keeps its log in memory; name a file with log=")
        return self._file

    def entries(self) -> list[LogEntry]:
        """The byte log so far."""
        return self._log.entries

    def close(self) -> None:
        """End the threads and remove the ports. Idempotent."""
        self.running = False
        self._undo.close()

    def _write(self) -> None:
        if self._file is not None:
            self._file.write_bytes(msgspec.json.Encoder().encode_lines(self._log.entries))

    def __enter__(self) -> "SimThreads":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
