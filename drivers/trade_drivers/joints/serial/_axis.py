"""The state of one servo on the bus thread: its measurements, and faults that forbid motion."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final, Generic, NamedTuple, Protocol, TypeVar

from msgspec import Struct

from trade_drivers.interfaces._motion import MotorState
from trade_drivers.joints import Axis, Goal, Resolution, Sample
from trade_robotfile import Joint

_HEALTH_STALE_NS: Final = 2_000_000_000


class Register(Protocol):
    """One register of a vendor's control table."""

    @property
    def address(self) -> int: ...
    @property
    def size(self) -> int: ...
    def decode(self, data: bytes, start: int = 0) -> int:
        """Returns the counts from a block of bytes read from address ``start``."""
        ...

    def encode(self, counts: int) -> bytes:
        """Returns the bytes of a number of counts."""
        ...


class Answer(NamedTuple):
    """The contents of a status packet."""

    data: bytes
    alert: bool
    """True if the device reports an error; its health says which."""


class Health(Struct, frozen=True, gc=False, kw_only=True):
    """One measurement of the slow block: health values."""

    torque: bool
    error: int
    """Error bits."""
    moving: bool
    voltage_v: float
    temperature_c: float
    at_ns: int


_Health = TypeVar("_Health", bound=Health)


class ServoAxis(Axis, Generic[_Health]):
    """One servo."""

    cyclic: ClassVar[tuple[int, int]]
    """Address and size of the block read from each joint in each cycle."""
    slow: ClassVar[tuple[int, int]]
    """Address and size of the slow block, read from one joint at a time."""
    settings: ClassVar[tuple[int, int]]
    """Address and size of the block of persistent registers; it begins at 0."""
    homing: ClassVar[Register]
    """The register of the homing offset."""
    ends: ClassVar[tuple[Register, Register]]
    """The registers of the low and the high end of its own range."""
    error_remedy: ClassVar[str]
    """The remedy for errors that it reports."""

    def __init__(
        self,
        name: str,
        bus: str,
        joint: Joint,
        resolution: Resolution,
        coupled: Sequence[str],
        *,
        model_number: int,
        full_effort_counts: int,
    ) -> None:
        super().__init__(name, bus, joint, resolution, coupled)
        self.model_number = model_number
        """The model number of the model in the robot file."""
        self._full_effort_counts = full_effort_counts
        self.own_range: tuple[int, int] = (0, int(2 * resolution.centre) - 1)
        """The positions that the device can hold, as its registers said last."""
        self.health: _Health | None = None
        self.health_due_ns = 0

    @abstractmethod
    def sampled(self, data: bytes, at_ns: int) -> Sample:
        """Decodes the measurement in a cyclic block."""

    @abstractmethod
    def examined(self, data: bytes, at_ns: int) -> _Health:
        """Decodes the measurement in a slow block."""

    @abstractmethod
    def problem(self, before: _Health | None, now: _Health) -> str:
        """Returns the fault that forbids motion; empty if there is none."""

    def take_sample(self, data: bytes, at_ns: int, now_ns: int) -> None:
        """Stores a cyclic measurement that was requested at a time and is read now."""
        self.note(self.sampled(data, at_ns), now_ns)

    def take_health(self, data: bytes, at_ns: int) -> _Health:
        """Stores a slow measurement, and latches its fault."""
        before, self.health = self.health, self.examined(data, at_ns)
        self.remedy = self.error_remedy if self.health.error else ""
        if problem := self.problem(before, self.health):
            self.fault, self.ready = problem, False
        return self.health

    def zero_moved(self, settings: bytes) -> str:
        """Returns what is wrong with the homing offset; empty if it is the one of the robot file's calibration."""
        found, expected = self.homing.decode(settings), self.joint.homing_counts
        if found == expected:
            return ""
        where = f"its homing offset (register {self.homing.address})"
        moved = "its zero has moved, or this is the calibration of another arm"
        return f"{where} is {found}, but {expected} in the robot file: {moved}"

    def own_goal(self, position: int) -> int:
        """Returns the goal that holds a position: the end of the device's own range, if that is near."""
        return max(self.own_range[0], min(self.own_range[1], position))

    def outside(self, position: int) -> str:
        """Returns why the device cannot hold a position; empty if it can."""
        end = self.own_goal(position)
        if abs(position - end) <= self.resolution.arrived:
            return ""
        register, here = self.ends[position > end], self.scale.angle_rad
        return (
            f"it is at {here(position):.3f} rad, outside its own range, which ends at {here(end):.3f} rad (register "
            f"{register.address}): it cannot hold there, and each goal drives it to that end"
        )

    def seed(self, position: int) -> Goal:
        """Returns the goal with which torque is switched on at a measured position.

        Raises:
            DeviceFault: the device cannot hold there, or its zero may have been lost.
        """
        self.check_zero(position)
        if problem := self.outside(position):
            raise self.fault_error(f"{problem}; turn it back by hand with its torque off, or widen that register")
        return Goal(self.own_goal(position), self.accel_counts, self.speed_counts)

    def brake(self, position: int) -> Goal:
        """Returns the goal of a hold: at full acceleration, even in a slow move.

        Outside its own range the device drives on to the end of that range, at the least speed that is not rest.
        """
        speed = self.resolution.still_velocity + 1 if self.outside(position) else self.speed_counts
        return Goal(self.own_goal(position), self.accel_counts, speed)

    @property
    def unheld(self) -> str:
        return "" if self.sample is None else self.outside(self.sample.position)

    @property
    def in_doubt(self) -> bool:
        """Whether its torque is unread since a missed exchange."""
        return self.doubted or self.silent

    @property
    def may_hold_torque(self) -> bool:
        """True if torque is on or unknown."""
        return self.health is None or self.health.torque

    def state(self, now_ns: int, stale_after_ns: int) -> MotorState:
        sample, health = self.fresh(now_ns, stale_after_ns), self.health
        if health is None or now_ns - health.at_ns > _HEALTH_STALE_NS:
            raise self.silent_error(now_ns)
        return self.measured(
            sample,
            now_ns,
            load=self.scale.load(sample.effort, self._full_effort_counts),
            enabled=health.torque,
            temperature_c=health.temperature_c,
            voltage_v=health.voltage_v,
        )
