"""One servo as the bus thread knows it, whoever built it: what is read of it, and what speaks against moving on."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final, Generic, NamedTuple, Protocol, TypeVar

from msgspec import Struct

from trade_drivers.interfaces._motion import MotorState
from trade_drivers.joints import Axis, Grain, Sample
from trade_drivers.robotfile import Joint

__all__ = ["Answer", "Health", "Register", "ServoAxis"]

_HEALTH_STALE_NS: Final = 2_000_000_000


class Register(Protocol):
    """One item of a vendor's table."""

    @property
    def address(self) -> int: ...
    @property
    def size(self) -> int: ...
    def decode(self, data: bytes, start: int = 0) -> int:
        """Counts, out of a block of bytes read from address ``start``."""
        ...

    def encode(self, counts: int) -> bytes:
        """The bytes of a number of counts."""
        ...


class Answer(NamedTuple):
    """A status packet's contents."""

    data: bytes
    alert: bool
    """The device has something to complain of; its health says what."""


class Health(Struct, frozen=True, gc=False, kw_only=True):
    """One slow measurement."""

    torque: bool
    error: int
    """Bits of what it has to complain of."""
    moving: bool
    voltage_v: float
    temperature_c: float
    at_ns: int


_Health = TypeVar("_Health", bound=Health)


class ServoAxis(Axis, Generic[_Health]):
    """One servo."""

    cyclic: ClassVar[tuple[int, int]]
    """Address and size of what is read of every joint in every cycle."""
    slow: ClassVar[tuple[int, int]]
    """Address and size of what is read of one joint at a time."""
    homing: ClassVar[Register]
    """What it adds to its position, or takes from it."""
    error_remedy: ClassVar[str]
    """What helps against what it complains of."""

    def __init__(
        self,
        name: str,
        bus: str,
        joint: Joint,
        grain: Grain,
        coupled: Sequence[str],
        *,
        model_number: int,
        full_effort_counts: int,
    ) -> None:
        super().__init__(name, bus, joint, grain, coupled)
        self.model_number = model_number
        """What a servo of the model in the robot file answers to a ping."""
        self._full_effort_counts = full_effort_counts
        self.health: _Health | None = None
        self.health_due_ns = 0

    @abstractmethod
    def sampled(self, data: bytes, at_ns: int) -> Sample:
        """The measurement in a cyclic block."""

    @abstractmethod
    def examined(self, data: bytes, at_ns: int) -> _Health:
        """The measurement in a slow block."""

    @abstractmethod
    def problem(self, before: _Health | None, now: _Health) -> str:
        """What in it speaks against moving on; empty if nothing does."""

    def take_sample(self, data: bytes, at_ns: int) -> None:
        """Note a cyclic measurement."""
        self.note(self.sampled(data, at_ns))

    def take_health(self, data: bytes, at_ns: int) -> _Health:
        """Note a slow measurement, and latch what speaks against moving on."""
        before, self.health = self.health, self.examined(data, at_ns)
        self.remedy = self.error_remedy if self.health.error else ""
        if problem := self.problem(before, self.health):
            self.fault, self.ready = problem, False
        return self.health

    @property
    def in_doubt(self) -> bool:
        """It missed an exchange, and its torque was not read since."""
        return self.doubted or self.silent

    @property
    def may_hold_torque(self) -> bool:
        """Torque is on, or nobody knows."""
        return self.health is None or self.health.torque

    def state(self, now_ns: int, stale_after_ns: int) -> MotorState:
        sample, health = self.fresh(now_ns, stale_after_ns), self.health
        if health is None or now_ns - health.at_ns > _HEALTH_STALE_NS:
            raise self.deaf(now_ns)
        return self.measured(
            sample,
            now_ns,
            load=self.scale.load(sample.effort, self._full_effort_counts),
            enabled=health.torque,
            temperature_c=health.temperature_c,
            voltage_v=health.voltage_v,
        )
