"""A robot on simulated devices, with its services in a system in memory: on virtual time, or on the real clock."""

import threading
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from msgspec.structs import replace

from trade import Container, where
from trade.errors import ConfigurationError, DeviceError
from trade.testing import MemorySystem, VirtualTime, VirtualTimeError, memory_system
from trade_drivers import AttachedRobot, Robot, attach, load
from trade_drivers.plugins._validate import own_clocks
from trade_hil_sim import Command, LogEntry, SimControl, SimProcess, SimThreads, SimulationError, remove_leftovers
from trade_hil_sim.control._command_line import command_of
from trade_hil_sim.control._server import State

__all__ = ["SimulatedRobot", "StartRobot", "find_file", "simulated_robot"]

_SEEN_S = 10.0
"""How long a client may take to know the robot's services."""


@dataclass(frozen=True, slots=True)
class SimulatedRobot:
    """A robot whose drivers exchange real bytes with a simulator.

    On virtual time, the simulator runs in threads of this process, and otherwise in a process of its own.
    """

    system: MemorySystem
    """The system in memory. A test partitions and kills its containers there."""
    container: Container
    """The container with the robot's services, named after the robot."""
    attached: AttachedRobot
    """The drivers, for a test that calls one without a container: ``attached.group("head")``."""
    sim: SimProcess | SimThreads
    """The simulator. Its log is a file in ``tmp_path``, and outlives the test."""
    _began: float
    _timers: list[threading.Timer] = field(default_factory=list[threading.Timer])
    _failures: list[Exception] = field(default_factory=list[Exception])

    @property
    def control(self) -> SimControl:
        """Injects faults, and knows the actual state of the devices."""
        return self.sim.control

    def log(self) -> list[LogEntry]:
        """Returns the bytes on all buses so far; `motion_writes` and its like of ``trade_hil_sim`` query them."""
        return self.sim.entries()

    def client(self, name: str = "client") -> Container:
        """Returns a container of the same system that knows the robot's services: a program's, or an operator's.

        Raises:
            NoSuchService: the robot's services do not appear there within 10 s.
        """
        container = self.system.container(name)
        container.find(where(group=f"{self.container.name}.faults", name="faults"), wait_s=_SEEN_S)
        return container

    def fault_at(self, at_s: float, fault: str) -> None:
        """Injects a fault at a time, in a thread of its own. The robot's end cancels what is due later.

        A fault that the simulator refuses at that time is raised at the robot's end.

        Args:
            at_s: when, in seconds since the robot was ready.
            fault: its name and keys, in the words of ``trade-hil-sim --do``: ``brown_out ids=1``.

        Raises:
            SimulationError: there is no such fault, it has other keys, or the time is over; nothing is injected.
        """
        command = command_of(fault.split() or [""])
        left_s = self._began + at_s - time.monotonic()
        if isinstance(command, State) or not left_s >= 0:
            passed = f"the robot has been ready for {at_s - left_s:.3f} s"
            raise SimulationError(f"{fault} at {at_s:g} s: {passed}; name a fault and a later time")
        timer = threading.Timer(left_s, self._inject, [command])
        timer.name = f"{fault} at {at_s:g} s"
        timer.start()
        self._timers.append(timer)

    def _inject(self, command: Command) -> None:
        try:
            self.control.do(command)
        except Exception as refused:  # noqa: BLE001 - raised at the robot's end
            self._failures.append(refused)

    def _end_timers(self) -> None:
        for timer in self._timers:
            timer.cancel()
        for timer in self._timers:
            timer.join()
        if self._failures:
            raise self._failures[0]


class StartRobot(Protocol):
    """The type of the fixture `simulated_robot`."""

    def __call__(self, robot_file: str | Path, *, rate_hz: float | None = None) -> SimulatedRobot:
        """Starts the robot of a robot file; ``rate_hz`` is as in `robots.simulated_robot`."""
        ...


def find_file(robot_file: str | Path, folders: Sequence[Path]) -> Path:
    """Returns the path of a robot file in the first folder that has it.

    Raises:
        ConfigurationError: none has it.
    """
    for folder in folders:
        if (folder / robot_file).is_file():
            return folder / robot_file
    problem = f"there is no such robot file in {' or '.join(map(str, dict.fromkeys(folders)))}"
    raise ConfigurationError(where=str(robot_file), problem=problem)


@contextmanager
def simulated_robot(
    robot_file: str | Path,
    system: MemorySystem | None = None,
    *,
    rate_hz: float | None = None,
    log_folder: Path | None = None,
) -> Generator[SimulatedRobot]:
    """Simulates a robot, attaches it, and registers its services in a container; ends all of them in reverse order.

    On virtual time, everything is in this process: simulated devices, drivers, containers and clients.

    Args:
        robot_file: its robot file.
        system: where its container is started; by default, in a new system that ends with the robot.
        rate_hz: cycles per second of all buses instead of the file's: what a long story costs grows with them.
        log_folder: where the simulator's log is written; by default, none outlives the robot.

    Raises:
        ConfigurationError: the file is wrong, or its drivers cannot attach the devices.
        SimulationError: the devices cannot be simulated.
        VirtualTimeError: on virtual time, a driver of the file has a clock of its own; names it.
    """
    robot = _slower(load(robot_file), rate_hz)
    virtual = VirtualTime.current() is not None
    if virtual:
        _refuse_own_clocks(robot)
    else:
        remove_leftovers()
    with ExitStack() as undo:
        system = system or undo.enter_context(memory_system())
        container = system.container(robot.name)
        log = log_folder and log_folder / f"{robot.name}.jsonl"
        sim = undo.enter_context(SimThreads(robot_file, log=log) if virtual else SimProcess(robot_file, log=log))
        attached = attach(robot, container, ports=sim.ports)
        undo.callback(_leave, attached)
        made = SimulatedRobot(system, container, attached, sim, time.monotonic())
        undo.callback(made._end_timers)
        yield made


def _slower(robot: Robot, rate_hz: float | None) -> Robot:
    if rate_hz is None:
        return robot
    return replace(robot, buses=[replace(bus, rate_hz=rate_hz) for bus in robot.buses])


def _leave(attached: AttachedRobot) -> None:
    with suppress(DeviceError):  # a device that the test has made faulty cannot be left as its file says
        attached.close()


def _refuse_own_clocks(robot: Robot) -> None:
    for key, why in own_clocks(robot):
        problem = f"{robot.where}: {key} cannot be on virtual time: {why}"
        raise VirtualTimeError(f"{problem}. Run this test on the real clock: @pytest.mark.real_clock")
