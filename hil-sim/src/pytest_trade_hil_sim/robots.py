"""A robot on simulated devices, with its services in a system in memory."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from trade import Container
from trade.errors import ConfigurationError, DeviceError
from trade.testing import MemorySystem
from trade_drivers import AttachedRobot, attach, load
from trade_hil_sim import Entry, SimControl, SimProcess, remove_leftovers

__all__ = ["SimulatedRobot", "find_file", "start_robot"]


@dataclass(frozen=True, slots=True)
class SimulatedRobot:
    """A robot whose drivers exchange real bytes with a simulator in a process of its own."""

    container: Container
    """The container with the robot's services, named after the robot."""
    attached: AttachedRobot
    """The drivers, for a test that calls one without a container: ``attached.group("head")``."""
    sim: SimProcess
    """The simulator's process. Its log is a file in ``tmp_path``, and outlives the test."""

    @property
    def control(self) -> SimControl:
        """Injects faults, and knows the actual state of the devices."""
        return self.sim.control

    def log(self) -> list[Entry]:
        """Returns the bytes on all buses so far; `motion_writes` and its like of ``trade_hil_sim`` query them."""
        return self.sim.entries()


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
def start_robot(robot_file: Path, system: MemorySystem, log_folder: Path) -> Generator[SimulatedRobot, None, None]:
    """Simulates a robot, attaches it, and registers its services in a container; ends all of them in reverse order.

    Args:
        robot_file: its robot file.
        system: where its container is started.
        log_folder: where the simulator's log is written.

    Raises:
        ConfigurationError: the file is wrong, or its drivers cannot attach the devices.
        SimulationError: the devices cannot be simulated.
    """
    robot = load(robot_file)
    remove_leftovers()
    container = system.container(robot.name)
    with SimProcess(robot_file, log=log_folder / f"{robot.name}.jsonl") as sim:
        attached = attach(
            robot,
            register=container.register,
            deregister=container.deregister,
            set_health=container.set_health,
            ports=sim.ports,
            healthy=container.healthy,
        )
        try:
            yield SimulatedRobot(container, attached, sim)
        finally:
            with suppress(DeviceError):  # a device that the test has made faulty cannot be left as its file says
                attached.close()
