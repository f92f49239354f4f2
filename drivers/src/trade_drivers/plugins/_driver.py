"""What a driver is, and finding one by its name: the entry points of the group ``trade.drivers``."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from typing import Any, ClassVar, Generic, TypeVar

from msgspec import Struct

from trade import Measure
from trade.errors import ConfigurationError
from trade_drivers import robotfile
from trade_drivers.bus._cycle import BusCycle
from trade_drivers.bus._thread import BusThread
from trade_drivers.bus.can._monitor import CanMonitor
from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.faults import Tell
from trade_drivers.interfaces._arm import Arm
from trade_drivers.interfaces._motion import Gripper, JointGroup, Motor
from trade_drivers.interfaces._sensing import Camera, Sensor
from trade_drivers.robotfile import Bus, Robot

__all__ = ["AnyDriver", "AttachedBus", "Driver", "SenseDriver", "ThreadedBus", "drivers", "load_driver"]

_GROUP = "trade.drivers"


class AttachedBus(ABC):
    """A bus whose devices were found to be those of the robot file. Nothing on it was moved or reset."""

    @abstractmethod
    def motor(self, joint: str) -> Motor:
        """The provider of one joint of this bus, named as in the robot file."""

    @abstractmethod
    def group(self, name: str, joints: Sequence[str]) -> JointGroup:
        """A provider of several joints of this bus; ``name`` is the group with the robot's name before it."""

    def gripper(self, name: str) -> Gripper:
        """The provider of one gripper of this bus, named as in the robot file.

        Raises:
            ConfigurationError: the driver of this bus has no grippers.
        """
        problem = "the driver of its bus has no grippers; one that has is robotiq"
        raise ConfigurationError(where=f'gripper."{name}"', problem=problem)

    def arm(self, name: str) -> Arm:
        """The provider of the arm on this bus, named as in the robot file.

        Raises:
            ConfigurationError: the driver of this bus has no arms.
        """
        raise ConfigurationError(where=f'arm."{name}"', problem="the driver of its bus has no arms; one that has is ur")

    def monitor(self, name: str) -> CanMonitor | None:  # noqa: ARG002 - most have none
        """The bus itself, to look at; ``name`` has the robot's before it. None if there is nothing to tell of it."""
        return None

    def measures(self, bus: str) -> Iterable[Measure]:  # noqa: ARG002 - whoever keeps none has none
        """Numbers of its own that are known already, for metrics; ``bus`` is its name with the robot's before it."""
        return ()

    def watched(self, tell: Tell) -> bool:  # noqa: ARG002 - whoever does not notice is asked
        """Have ``tell`` told what is wrong with devices of this bus, now and at every change, by whoever notices first.

        Returns whether that is done; else their ``state()`` is asked again and again.
        """
        return False

    def unseen(self) -> Sequence[str]:
        """The names of the devices that were not seen at rest when they were left; whoever cannot tell names none."""
        return ()

    @abstractmethod
    def close(self) -> None:
        """Stop everything, leave the devices as the robot file asks, let go of the port; more than once is fine.

        Raises:
            TradeError: something could not be left as asked; the port is let go all the same.
        """


_Exchange_co = TypeVar("_Exchange_co", bound=BusCycle[Any], covariant=True)


class ThreadedBus(AttachedBus, Generic[_Exchange_co]):
    """An attached bus that a thread owns."""

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
    """What every driver says of itself."""

    commissioner: ClassVar[type[Commissioner] | None] = None
    """What finds its devices and sets them up; None if they are set up otherwise."""
    modules: ClassVar[tuple[str, ...]] = ()
    """What of others it imports; installed with the extra of its name."""

    @classmethod
    def missing(cls) -> list[str]:
        """Those of its modules that are not installed."""
        return [module for module in cls.modules if find_spec(module) is None]


class Driver(AnyDriver, ABC):
    """One vendor's devices; made without arguments, and harmless to make."""

    without_watchdog: ClassVar[str] = ""
    """What its devices do when their driver is gone, if they have no watchdog; empty if they have one."""
    devices: ClassVar[tuple[type[Struct], ...]] = (robotfile.Joint, robotfile.Gripper, robotfile.Arm)
    """What a bus of it can have."""

    def check(self, robot: Robot, bus: Bus) -> None:
        """Look at what the file alone can tell of a bus and its devices; nothing is opened, and nobody is asked.

        Raises:
            ConfigurationError: the vendor library is missing, or ``attach`` would refuse the file; names file and key.
        """

    def fits(self, bench: Bench, robot: Robot, bus: Bus, device: robotfile.Joint | robotfile.Gripper) -> None:
        """Look whether a device on an open line is set up as the robot file needs it. Nothing is written.

        Raises:
            ConfigurationError: ``attach`` would refuse it; names file and key.
            WireError: it does not answer reliably.
        """

    @abstractmethod
    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        """Take a bus over and check its devices, moving and resetting nothing; found moving, they are stopped.

        Args:
            robot: the whole file.
            bus: the bus to attach.
            port: where it is; instead of ``bus.port``.
            healthy: asked in every cycle; while it says no, the driver tells its devices to hold and falls silent, so
                that their own watchdogs take over.

        Raises:
            ConfigurationError: the vendor library is missing, the port cannot be had, or a device is absent, another
                model, or set wrongly.
        """


class SenseDriver(AnyDriver, ABC):
    """Cameras or sensors of one kind, each with a table of its own; made without arguments, and harmless to make."""

    def check(self, device: robotfile.Camera | robotfile.Sensor) -> None:
        """Look at its options; nothing is opened, and nobody is asked.

        Raises:
            ConfigurationError: ``attach`` would refuse them; names file and key.
        """

    @abstractmethod
    def attach(self, name: str, device: robotfile.Camera | robotfile.Sensor, port: str | None) -> Camera | Sensor:
        """Look whether the device is there and is what the file says; nothing of it is moved, reset or set.

        Args:
            name: of the device, with the robot's before it.
            device: its table; ``device.options_as(Options)`` reads its options.
            port: where it is, instead of where its options say; None: there.

        Raises:
            ConfigurationError: an option is wrong, or the device is absent, another, or set wrongly.
        """


_Kind = TypeVar("_Kind", bound=AnyDriver)


def drivers() -> dict[str, list[EntryPoint]]:
    """The installed drivers by name; more than one under a name is a mistake of the installation."""
    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=_GROUP):
        found.setdefault(point.name, []).append(point)
    return found


def load_driver(name: str, where: str, wanted: type[_Kind]) -> _Kind:
    """The driver of that name.

    Args:
        name: as in the robot file's ``driver``.
        where: the key that names it, for messages.
        wanted: ``Driver`` for a bus, ``SenseDriver`` for a camera or sensor, ``AnyDriver`` for either.

    Raises:
        ConfigurationError: there is none, there are two, it cannot be imported, or it is of the other kind.
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
        problem = f"driver {name!r} ({_origin(points[0])}) is no subclass of trade_drivers.{wanted.__name__}"
        raise ConfigurationError(where=where, problem=problem)
    return kind()


def _origin(point: EntryPoint) -> str:
    dist = f" of {point.dist.name} {point.dist.version}" if point.dist is not None else ""
    return f"{point.value}{dist}"
