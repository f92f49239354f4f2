"""What a safety rule needs of a vendor: a simulator, the driver attached to it, commands, and the simulator's log."""

import os
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

from tests.support.waiting import wait_until
from tests.unit import drivers
from tests.unit.drivers.conftest import Outcome
from trade import Container, Handle, where
from trade.errors import TradeError
from trade_hil_sim import Absent, LogEntry, received

PROCESSES = Path(next(iter(drivers.__path__)))


Request = Sequence[Any]
"""The name of a service and its arguments."""


def answers(act: Callable[[], object]) -> bool:
    try:
        act()
    except TradeError:
        return False
    return True


class DriverProcess:
    """A driver in a process of its own that moves its device slowly."""

    def __init__(self, program: str, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(PROCESSES / program), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


class SafetyRig(ABC):
    """A simulated device of one vendor and its driver."""

    vendor: ClassVar[str]
    """The name of its driver."""
    column: ClassVar[str]
    """The name of its wire in docs/safety-tests.md."""
    lacks: ClassVar[Mapping[str, str]] = {}
    """Rules that do not apply to this device, each with the reason."""
    says_on_waking: ClassVar[Sequence[str]] = ()
    """Parts of the error of a driver that was frozen."""
    stops_without_driver: ClassVar[bool] = True
    """Whether the device stops when its driver falls silent; if not, it ends the move that it was sent last."""
    absent: ClassVar[Absent] = Absent()
    """Takes a device away before the driver is attached."""
    says_absent: ClassVar[Sequence[str]]
    """Parts of the refusal: the key of the device and what to check."""
    swapped: ClassVar[Any]
    """Puts a device of another model in the place of the one in the robot file."""
    says_model: ClassVar[str]
    """The part of the refusal that names both models."""
    lost: ClassVar[Sequence[Any]]
    """Faults that lose or damage an answer."""
    library: ClassVar[tuple[str, str]]
    """The library that the driver needs: its package and its module."""
    importing: ClassVar[Sequence[str]] = ()
    """Modules of the drivers on the way to the import of the library."""
    resource: ClassVar[str]
    """What is locked before the device is moved."""
    robot: Any
    device: Any

    def __init__(self, undo: ExitStack, folder: Path) -> None:
        self.undo, self.folder, self._plugged = undo, folder, False
        self.bench = self.on_the_bench()

    @abstractmethod
    def on_the_bench(self) -> Any:
        """The simulator that the other tests of this driver use, too."""

    def configure(self, *changes: tuple[str, str]) -> None:
        """Change the robot file before the device is plugged in."""
        self.bench.configure(*changes)

    patience: ClassVar[Sequence[tuple[str, str]]] = ()
    """Changes of the robot file that give the watchdog more time than a test holds the bus up."""

    def patient(self) -> None:
        if self.patience:
            self.configure(*self.patience)

    def plug(self) -> None:
        if not self._plugged:
            self.bench.plug()
            self._plugged = True

    def swap(self) -> None:
        self.plug()
        self.bench.sim.do(self.swapped)

    @abstractmethod
    def attach(self, **options: Any) -> None:
        """Attach the driver; it is closed with the test."""

    @abstractmethod
    def ready(self) -> None:
        """Make the device able to move."""

    def attach_to_command(self, **options: Any) -> None:
        """Attach, and make the device able to take each of its `commands`."""
        self.attach(**options)

    @property
    def exchange(self) -> Any:
        return self.device._exchange

    @abstractmethod
    def commands(self) -> Iterable[Callable[[], object]]:
        """Every command that moves the device, or switches its torque."""

    @abstractmethod
    def move(self) -> object:
        """Move far."""

    @abstractmethod
    def set_off(self) -> Outcome:
        """Start a slow and long move; return once the device is under way."""

    def service(self, container: Container, name: str, group: str = "") -> Handle:
        return container.find(where(name=name, group=group or self.resource), wait_s=20).with_(deadline_s=60)

    def asked(self, container: Container, request: Request) -> Any:
        """What the service of the device answers."""
        name, *values = request
        return self.service(container, name)(*values)

    def started(self, container: Container, request: Request) -> Any:
        name, *values = request
        return self.service(container, name).start(*values)

    @property
    @abstractmethod
    def far(self) -> Request:
        """Move far."""

    @property
    @abstractmethod
    def slowly(self) -> Request:
        """The same, in a time in which a test can interfere."""

    set_point: ClassVar[Request] = ()
    """Move until the time given with it is over."""
    readying: ClassVar[Request]
    """Become able to move."""
    harmless: ClassVar[Request] = ("state",)
    """Use the device without disturbing its motion."""

    @abstractmethod
    def requests(self, container: Container) -> Iterable[Callable[[], object]]:
        """Every service that needs the lock of the device."""

    @abstractmethod
    def moves_back(self, container: Container) -> bool:
        """Whether a short move succeeds."""

    drift: ClassVar[float]
    """How much of the long move the set-point takes when nothing ends it earlier."""

    def judge_return(self) -> None:  # noqa: B027 - most devices have nothing to add
        """What else holds once the device has been away and is back."""

    def judge_ended(self) -> None:  # noqa: B027 - most devices have nothing to add
        """What the wire must show of a motion that has ended before its goal."""

    @abstractmethod
    def outside(self) -> Iterable[Callable[[], object]]:
        """Commands beyond the limits, or with values that are not numbers."""

    @abstractmethod
    def commanded(self, since: float = 0.0) -> Sequence[object]:
        """Everything sent that moves the device, or switches its torque."""

    def ordered(self, since: float) -> Sequence[object]:
        """Everything sent to a device that is able to move that changes what it does."""
        return self.commanded(since)

    def written(self) -> Sequence[object]:
        """Everything sent that attaching to a device at rest must not send."""
        return self.commanded()

    @abstractmethod
    def sent_away(self, since: float, within_rad: float = 0.002) -> Sequence[object]:
        """Everything sent that leads the device away from where it is, farther than joints brake."""

    def sent_on_waking(self, since: float) -> Sequence[object]:
        """What a driver sends, after its device has stopped without it, that must not be."""
        return self.sent_away(since)

    @abstractmethod
    def events(self, name: str, since: float) -> Sequence[LogEntry]:
        """What the simulator noted of the device."""

    @property
    @abstractmethod
    def moving(self) -> bool: ...

    @abstractmethod
    def travelled(self) -> float:
        """How much of the long move is done, from 0 to 1."""

    def queued(self) -> Iterable[Callable[[], object]]:
        """The commands that the bus thread takes up, once the device is able to take them."""
        return self.commands()

    def queued_when_ready(self) -> Iterable[Callable[[], object]]:
        """Those of them that change something at a device that is able to move."""
        return self.queued()

    def at_rest(self) -> bool:
        return not self.moving

    def rests(self) -> None:
        """Wait until the device rests, short of the goal."""
        wait_until(lambda: not self.moving, "it rests")
        assert self.travelled() < 0.9

    @abstractmethod
    def driver_process(self) -> DriverProcess:
        """A driver process that moves the device slowly."""

    @abstractmethod
    def last_resort(self, lost: float) -> None:
        """Judge what the device does after its driver is lost at a moment."""

    def falls_silent(self) -> float:
        """Wait until the device is left alone; since when nothing may be sent."""
        raise NotImplementedError

    def heard(self, since: float) -> Sequence[LogEntry]:
        """Everything that the device received."""
        return received(self.bench.log, since=since)
