"""The base classes of drivers, and their entry points in the group ``trade.drivers``."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from typing import Any, ClassVar, Generic, TypeVar

from msgspec import Struct

import trade_robotfile
from trade import Measure
from trade.errors import ConfigurationError
from trade_drivers.bus._angle_store import AngleStore
from trade_drivers.bus._can_monitor import CanMonitor
from trade_drivers.bus._cycle import BusCycle
from trade_drivers.bus._thread import BusThread
from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.faults import Tell
from trade_drivers.interfaces._arm import Arm
from trade_drivers.interfaces._motion import Gripper, JointGroup, Motor
from trade_drivers.interfaces._sensing import Camera, Sensor
from trade_robotfile import Bus, Robot

_GROUP = "trade.drivers"


class AttachedBus(ABC):
    """A bus with verified devices of the robot file. Attaching moved and reset nothing."""

    @abstractmethod
    def motor(self, joint: str) -> Motor:
        """Returns the provider of a joint of this bus by its name in the robot file."""

    @abstractmethod
    def group(self, name: str, joints: Sequence[str]) -> JointGroup:
        """Returns a provider of several joints of this bus; ``name`` is the group with the robot's name as prefix."""

    def gripper(self, name: str) -> Gripper:
        """Returns the provider of a gripper of this bus by its name in the robot file.

        Raises:
            ConfigurationError: the driver of this bus has no grippers.
        """
        problem = "the driver of its bus has no grippers; use one that has, such as robotiq"
        raise ConfigurationError(where=f'gripper."{name}"', problem=problem)

    def arm(self, name: str) -> Arm:
        """Returns the provider of the arm on this bus by its name in the robot file.

        Raises:
            ConfigurationError: the driver of this bus has no arms.
        """
        raise ConfigurationError(where=f'arm."{name}"', problem="the driver of its bus has no arms; use driver ur")

    def monitor(self, name: str) -> CanMonitor | None:  # noqa: ARG002 - most buses have none
        """Returns the monitor of the bus, if it has one; ``name`` has the robot's name as prefix."""
        return None

    def measures(self, bus: str) -> Iterable[Measure]:  # noqa: ARG002 - by default none
        """Returns metrics from values already known; ``bus`` is its name with the robot's as prefix."""
        return ()

    def watched(self, tell: Tell) -> bool:  # noqa: ARG002 - by default it reports none
        """Subscribes ``tell`` to the faults of this bus's devices, now and at each change.

        Returns False if the bus does not report faults; then their ``state()`` is polled.
        """
        return False

    def remember(self, angles: AngleStore) -> None:  # noqa: B027 - by default no device loses its zero
        """Compares joints with their last known angles, and saves these from now on.

        A joint whose zero may have been lost refuses to be enabled.
        """

    def unseen(self) -> Sequence[str]:
        """Returns the names of devices that were not seen at rest when the driver left them, as far as it knows."""
        return ()

    @abstractmethod
    def close(self) -> None:
        """Stops everything, leaves the devices as the robot file says, and closes the port. Idempotent.

        Raises:
            TradeError: a device could not be left as the file says; the port is closed nevertheless.
        """


_Exchange_co = TypeVar("_Exchange_co", bound=BusCycle[Any], covariant=True)


class ThreadedBus(AttachedBus, Generic[_Exchange_co]):
    """An attached bus with an owner thread."""

    def __init__(self, thread: BusThread[_Exchange_co]) -> None:
        self._thread = thread

    def measures(self, bus: str) -> Iterable[Measure]:
        return self._thread.measures(bus)

    def watched(self, tell: Tell) -> bool:
        self._thread.watched(tell)
        return True

    def unseen(self) -> Sequence[str]:
        return self._thread.unseen

    def close(self) -> None:
        self._thread.close()


class AnyDriver:
    """What bus drivers and sense drivers have in common."""

    commissioner: ClassVar[type[Commissioner] | None] = None
    """Scans for devices and sets them up; None if the driver does not support that."""
    modules: ClassVar[tuple[str, ...]] = ()
    """Libraries that the driver imports; the extra of its name installs them."""
    own_clock: ClassVar[str] = ""
    """Why its devices cannot be on virtual time, such as a library in C that waits by itself; empty if they can."""

    @classmethod
    def missing(cls) -> list[str]:
        """Returns those of ``modules`` that are not installed."""
        return [module for module in cls.modules if find_spec(module) is None]


class Driver(AnyDriver, ABC):
    """The driver of one vendor's devices; constructed without arguments and without side effects."""

    without_watchdog: ClassVar[str] = ""
    """What the devices do without a driver if they have no watchdog; empty if they have one."""
    devices: ClassVar[tuple[type[Struct], ...]] = (trade_robotfile.Joint, trade_robotfile.Gripper, trade_robotfile.Arm)
    """The kinds of device on its buses."""

    def check(self, robot: Robot, bus: Bus) -> None:
        """Checks a bus and its devices as far as the file shows mistakes, without access to any device.

        Raises:
            ConfigurationError: the vendor library is missing, or ``attach`` would refuse the file; names file and key.
        """

    def fits(
        self, bench: Bench, robot: Robot, bus: Bus, device: trade_robotfile.Joint | trade_robotfile.Gripper
    ) -> None:
        """Checks that a device on an open line is set up as the robot file requires. Writes nothing.

        Raises:
            ConfigurationError: ``attach`` or ``enable`` would refuse the device; names file and key.
            WireError: the device does not answer reliably.
        """

    @abstractmethod
    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        """Opens a bus and checks its devices; moves and resets nothing, and stops devices that move.

        Args:
            robot: the whole file.
            bus: the bus to attach.
            port: the port to use instead of ``bus.port``.
            healthy: called in each cycle; while it returns False, the driver commands its devices to hold and is
                silent, so that their own watchdogs take over.

        Raises:
            ConfigurationError: the vendor library is missing, the port cannot be opened, or a device is absent,
                another model, or misconfigured.
        """


class SenseDriver(AnyDriver, ABC):
    """The driver of one kind of camera or sensor; constructed without arguments and without side effects."""

    def check(self, device: trade_robotfile.Camera | trade_robotfile.Sensor) -> None:
        """Checks the options without access to the device.

        Raises:
            ConfigurationError: ``attach`` would refuse the options; names file and key.
        """

    @abstractmethod
    def attach(
        self, name: str, device: trade_robotfile.Camera | trade_robotfile.Sensor, port: str | None
    ) -> Camera | Sensor:
        """Opens the device and checks that it is the one in the file; moves, resets and sets nothing.

        Args:
            name: of the device, with the robot's name as prefix.
            device: the device's table; ``device.options_as(Options)`` reads its options.
            port: the port to use instead of the one in the options; None for that one.

        Raises:
            ConfigurationError: an option is wrong, or the device is absent, another, or misconfigured.
        """


_Kind = TypeVar("_Kind", bound=AnyDriver)


def drivers() -> dict[str, list[EntryPoint]]:
    """Returns the installed drivers by name; more than one for a name is an installation error."""
    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=_GROUP):
        found.setdefault(point.name, []).append(point)
    return found


def load_driver(name: str, where: str, wanted: type[_Kind]) -> _Kind:
    """Loads a driver by its name.

    Args:
        name: the value of ``driver`` in the robot file.
        where: the key of that value, for messages.
        wanted: ``Driver`` for a bus, ``SenseDriver`` for a camera or sensor, ``AnyDriver`` for either.

    Raises:
        ConfigurationError: there is no such driver, there are two, it cannot be imported, or it is of the other kind.
    """
    found = drivers()
    points = found.get(name, [])
    if not points:
        problem = f"there is no driver {name!r}; installed: {', '.join(sorted(found)) or 'none'}"
        raise ConfigurationError(where=where, problem=problem)
    if len({point.value for point in points}) > 1:
        both = " and ".join(sorted(_origin(point) for point in points))
        raise ConfigurationError(where=where, problem=f"two drivers are named {name!r}: {both}; uninstall one")
    try:
        kind = points[0].load()
    except (ImportError, AttributeError) as broken:
        problem = f"driver {name!r} ({_origin(points[0])}) cannot be imported: {broken}"
        raise ConfigurationError(where=where, problem=problem) from broken
    if not (isinstance(kind, type) and issubclass(kind, wanted)):
        problem = f"driver {name!r} ({_origin(points[0])}) is not a subclass of trade_drivers.{wanted.__name__}"
        raise ConfigurationError(where=where, problem=problem)
    return kind()


def _origin(point: EntryPoint) -> str:
    dist = f" of {point.dist.name} {point.dist.version}" if point.dist is not None else ""
    return f"{point.value}{dist}"
