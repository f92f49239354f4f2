"""Builds simulated buses from a robot file, by the class for each driver. The only module that reads robot files."""

from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

from trade_hil_sim.faults._commands import Command, SimulationError
from trade_hil_sim.log._byte_log import ByteLog
from trade_hil_sim.mechanics._truth import BusState
from trade_robotfile import Arm, Bus, Camera, Gripper, Joint, Robot, Sensor

GROUP: Final = "trade.sims"
"""Entry points of this group are `SimulatedBusClass`es, or for cameras and sensors `SimulatedSenseClass`es; their names
are those of the drivers that they replace."""

Truth = Callable[[], Sequence[BusState]]
"""The true state of all buses of the robot."""


class SimulatedBus(Protocol):
    """One bus with its devices, or a camera, or a sensor: everything behind one port."""

    @property
    def name(self) -> str:
        """Its name in the robot file."""
        ...

    @property
    def port(self) -> Path | str:
        """The port for clients: a path, or such as ``socketcand:127.0.0.1:29536/can0``; final from `open` on."""
        ...

    def open(self) -> object:
        """From now on the port can be opened."""
        ...

    def close(self) -> None:
        """Free all resources; idempotent."""
        ...

    def do(self, command: Command) -> None:
        """Carry out a fault or an order; raises `SimulationError` if it does not support it."""
        ...

    def state(self) -> BusState:
        """The actual state of its devices."""
        ...


@runtime_checkable
class SimulatedBusClass(Protocol):
    """The class that an entry point of the group ``trade.sims`` names for a driver of buses."""

    def from_robot(
        self,
        bus: Bus,
        devices: Sequence[Joint | Gripper | Arm],
        port: Path,
        *,
        log: ByteLog | None = None,
        paced: bool = True,
    ) -> SimulatedBus:
        """Create the bus of a robot file, not yet open; raises `SimulationError` naming what is not supported."""
        ...


@runtime_checkable
class SimulatedSenseClass(Protocol):
    """The class that such an entry point names for a driver of cameras or sensors."""

    def from_record(
        self,
        device: Camera | Sensor,
        port: Path,
        *,
        truth: Truth,
        log: ByteLog | None = None,
        paced: bool = True,
    ) -> SimulatedBus:
        """Create the device of a robot file, not yet open; raises `SimulationError` naming what is not supported."""
        ...


def buses_of(
    robot: Robot, directory: Path, *, names: Sequence[str] = (), log: ByteLog | None = None, paced: bool = True
) -> list[SimulatedBus]:
    """Simulate the buses, cameras and sensors of a robot, not yet open; each gets the port ``directory / name``.

    Args:
        robot: from `trade_robotfile.load`.
        directory: of the ports.
        names: of those to simulate; default: all.
        log: where all record.
        paced: take the time of the real wires.
    """
    senses = (*robot.cameras, *robot.sensors)
    known = {device.name for device in (*robot.buses, *senses)}
    for name in names:
        if name not in known:
            raise SimulationError(f"{robot.where} has no bus {name!r}; it has {', '.join(sorted(known))}")
    buses = [
        bus_class(bus.driver).from_robot(
            bus,
            [*robot.joints_on(bus.name), *robot.grippers_on(bus.name), *robot.arms_on(bus.name)],
            directory / bus.name,
            log=log,
            paced=paced,
        )
        for bus in robot.buses
        if not names or bus.name in names
    ]

    def truth() -> list[BusState]:
        return [bus.state() for bus in buses]

    return buses + [
        _sense_class(device.driver).from_record(device, directory / device.name, truth=truth, log=log, paced=paced)
        for device in senses
        if not names or device.name in names
    ]


def bus_class(driver: str) -> SimulatedBusClass:
    """The class that simulates the buses of a driver.

    Raises:
        SimulationError: there is none.
    """
    found = find_simulator(driver)
    if not isinstance(found, SimulatedBusClass):
        raise SimulationError(f"driver {driver!r} is one of cameras or sensors; a bus needs another")
    return found


def _sense_class(driver: str) -> SimulatedSenseClass:
    found = find_simulator(driver)
    if not isinstance(found, SimulatedSenseClass):
        raise SimulationError(f"driver {driver!r} is one of buses; a camera or sensor needs another")
    return found


def find_simulator(
    driver: str, installed: Sequence[EntryPoint] | None = None
) -> SimulatedBusClass | SimulatedSenseClass:
    """The class that simulates the devices of a driver.

    Args:
        driver: its name in robot files.
        installed: where to search; default: the entry points of all installed packages.

    Raises:
        SimulationError: there is none, or more than one.
    """
    offered = list(entry_points(group=GROUP) if installed is None else installed)
    values = sorted({point.value for point in offered if point.name == driver})
    if len(values) > 1:
        raise SimulationError(f"two simulators are named {driver!r}: {' and '.join(values)}; uninstall one")
    if not values:
        known = ", ".join(sorted({point.name for point in offered})) or "none"
        raise SimulationError(f"nothing simulates driver {driver!r}; simulated are: {known}")
    point = next(point for point in offered if point.name == driver)
    found: SimulatedBusClass | SimulatedSenseClass = point.load()
    return found
