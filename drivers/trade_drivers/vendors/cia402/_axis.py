"""The state of one drive on the bus thread: its last frames, faults that forbid motion, and its cyclic set-points.

No I/O.
"""

from collections.abc import Sequence
from enum import Enum, auto
from math import copysign, sqrt
from struct import error as BadLength  # noqa: N812 - what unpacking raises for another number of bytes
from typing import Final

from trade.errors import DeviceError
from trade_drivers.interfaces._motion import MotorState
from trade_drivers.joints import Ramp, Sample, towards
from trade_drivers.joints.can import MotorAxis, resolution_of
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._table import State, state_of
from trade_drivers.vendors.cia402._wire import emergency_text
from trade_robotfile import Joint

_FAULTS: Final = (State.FAULT, State.FAULT_REACTION)
_SOME_FAULT: Final = "it reports a fault"
_STOPPED: Final = "network management has stopped it: it answers nothing until it is taken back"
_ACKNOWLEDGE_NS: Final = 250_000_000
"""The time allowed for a drive to accept a set-point."""


class Following(Ramp):
    """Cyclic synchronous position: each position is reached one period after the SYNC that activates it."""

    def __init__(self, node: int, position: int, *, speed: float, accel: float, period_s: float) -> None:
        super().__init__(position, fastest=speed, accel=accel, braking=accel / 2)
        self.can_id = table.FOLLOWING.base + node
        self._period_s = period_s

    def next(self, sample: Sample, now_ns: int) -> bytes:  # noqa: ARG002 - that is the drive's own business in this mode
        """Returns the frame data for the next period."""
        self.step(self._period_s)
        return table.FOLLOWING.layout.pack(self.target)

    @property
    def target(self) -> int:
        """The last set-point."""
        return round(self.position)


class Turning:
    """Cyclic synchronous velocity, or profile velocity with ramps of the same steepness.

    The velocity is 0 until the end and the speed are set. It slows down early enough for the drive to stop within the
    range even if the driver's frames stop, which the drive notices after ``blind_s``. Without a new measurement, it
    assumes that the joint follows the commanded velocity.

    The drive's own units of speed and acceleration are so many counts/s and counts/s^2 of its positions.
    """

    def __init__(
        self,
        node: int,
        *,
        accel: int,
        period_s: float,
        blind_s: float,
        speed_unit: float = 1.0,
        accel_unit: float = 1.0,
    ) -> None:
        self.can_id = table.TURNING.base + node
        self.end: int | None = None
        """The end of its motion, in counts."""
        self.fastest = 0.0
        """Speed in the drive's own unit, without a sign."""
        self._speed = 0.0
        self._ramp, self._accel, self._speed_unit = accel, accel * accel_unit, speed_unit
        self._period_s, self._blind_s = period_s, blind_s
        self._measured_ns = self._sent_ns = 0
        self._travelled = 0.0
        """Expected motion since the last measurement, in counts."""

    def next(self, sample: Sample, now_ns: int) -> bytes:
        """Returns the frame data for the next period, from the newest measurement."""
        if sample.at_ns == self._measured_ns:
            self._travelled += self._speed * (now_ns - self._sent_ns) / 1e9
        else:
            self._travelled = self._speed * (now_ns - sample.at_ns) / 1e9
        self._measured_ns, self._sent_ns = sample.at_ns, now_ns
        wanted = 0.0 if self.end is None else self._allowed(self.end - sample.position - self._travelled)
        self._speed = towards(self._speed, wanted, self._accel * self._period_s)
        speed = int(round(self._speed / self._speed_unit, 6))  # never faster than allowed
        return table.TURNING.layout.pack(self._ramp, speed)

    def _allowed(self, left: float) -> float:
        blind = self._accel * self._blind_s
        return copysign(
            min(self.fastest * self._speed_unit, sqrt(blind * blind + 2 * self._accel * abs(left)) - blind), left
        )


class Stage(Enum):
    """The stages of a drive's admission to the cycle, described in ``Admission``."""

    AWAY = auto()
    VERIFYING = auto()
    SET_UP = auto()
    HERE = auto()


class DriveAxis(MotorAxis):
    """One drive."""

    def __init__(self, name: str, bus: str, joint: Joint, rate_hz: float, coupled: Sequence[str] = ()) -> None:
        super().__init__(name, bus, joint, resolution_of(joint, rate_hz, joint.counts_per_rev or 1.0), coupled)
        self.identity: tuple[int, ...] = ()
        """The identity when it was attached."""
        self.state_now: State | None = None
        self.statusword = 0
        self.mode = 0
        self.modes: frozenset[int] = frozenset()
        """The supported modes of operation."""
        self.entered = 0
        """The mode in which it was enabled; 0 if unknown."""
        self.stream: Following | Turning | None = None
        """In a mode without a goal: the generator of its cyclic set-points."""
        self.velocity = 0
        self.controlword = 0
        """The last controlword that was sent."""
        self.target = 0
        self.raised_ns = 0
        """When its set-point bit was raised; 0 after the drive acknowledged it."""
        self.stage = Stage.AWAY
        """The admission stage; only in the last one it is not ``silent``."""
        self.set_up_ns = 0
        """When it was last checked and set up."""
        self.answered_ns = 0
        """When a measurement that arrived while it was left out was requested."""
        self.stopped = False
        """True after a heartbeat in state stopped by network management: it answers nothing until restarted."""
        self.recalled = False
        """True while a job waits until it is restarted and set up."""
        self.own_range: tuple[int, int] | None = None
        """The drive's own limits of positions (607Dh), in counts."""
        self.unfit = ""
        """Why it was not admitted again, though it answers."""
        self.operational = False
        """Whether it is operational, as far as its heartbeats and the commands to it say."""
        self.to_start = False
        """True if its heartbeat contradicts the start command: the frame was lost, or it fell back."""

    # --- received frames

    def take_status(self, data: bytes, now_ns: int) -> None:
        """Handles TPDO1. Only the first TPDO1 after each SYNC counts."""
        asked_ns, self.asked_ns = self.asked_ns, 0
        if not asked_ns:
            return
        try:
            statusword, position, torque = table.STATUS.layout.unpack(data)
        except BadLength:
            return
        if self.silent:
            self.answered_ns = asked_ns
            return
        self.statusword = statusword
        self.state_now = state_of(self.statusword)
        self.note(Sample(position, self.velocity, torque, asked_ns), now_ns)
        self._judge(asked_ns)

    def take_motion(self, data: bytes) -> None:
        """Handles TPDO2."""
        try:
            self.velocity, self.mode, error = table.MOTION.layout.unpack(data)
        except BadLength:
            return
        if error and self.state_now in _FAULTS:
            self.latch(emergency_text(error))

    def take_emergency(self, data: bytes) -> None:
        """Handles an EMCY of any length; code 00xx reports the end of an error, but clears no latched fault."""
        code = int.from_bytes(data[:2], "little")
        if code & 0xFF00:
            self.latch(emergency_text(code))

    def take_heartbeat(self, data: bytes, now_ns: int) -> None:
        """Handles a heartbeat or a boot-up message; after a boot, earlier commands are lost."""
        state = data[0] & 0x7F if data else table.BOOT_UP
        self.stopped, self.operational = state == table.STOPPED, state == table.OPERATIONAL
        if state == table.BOOT_UP:
            self._lose("it has restarted; is its supply sound?", now_ns)
        elif state == table.OPERATIONAL:
            self.beat_ns = now_ns
        elif self.stage is Stage.SET_UP:
            self.to_start = True
        elif not self.silent:
            why = f"network management has made it {table.NMT_STATES.get(state, hex(state))}"
            self._lose(_STOPPED if self.stopped else why, now_ns)

    def _lose(self, reason: str, now_ns: int) -> None:
        if self.ready:
            self.latch(reason)
        self.forget(now_ns)

    def forget(self, now_ns: int) -> None:
        """Leaves it out until it is checked again, which may be immediately."""
        super().forget(now_ns)
        self.stage, self.probe_at_ns = Stage.AWAY, now_ns
        self.controlword = self.raised_ns = 0
        self.entered, self.stream = 0, None

    def await_frames(self, now_ns: int) -> None:
        """Starts the wait for its frames after set-up."""
        if self.ready:
            self.latch("it was away")
        self.stage, self.set_up_ns, self.unfit = Stage.SET_UP, now_ns, ""
        self.entered, self.stream = 0, None

    def welcome(self, now_ns: int) -> None:
        """Accepts it after its frames have arrived."""
        self.stage = Stage.HERE
        self.zero.interrupted()
        self.silent, self.silent_since_ns, self.sample = False, now_ns, None
        self.controlword = self.raised_ns = self.asked_ns = 0

    def latch(self, fault: str) -> None:
        """Latches a fault until it is enabled again; the first one is kept."""
        if self.fault in {"", _SOME_FAULT}:
            self.fault = fault
        self.ready = False

    def _judge(self, now_ns: int) -> None:
        state = self.state_now
        if state in _FAULTS:
            self.latch(_SOME_FAULT)
        elif self.ready and state is State.QUICK_STOP:
            self.latch("it has made a quick stop by itself: it heard nothing for too long, or a switch triggered it")
        elif self.ready and state is not State.ENABLED:
            self.latch("its torque went off: it lost power, or its protection switched it off")
        elif self.ready and self.raised_ns and now_ns - self.raised_ns > _ACKNOWLEDGE_NS and not self.acknowledged:
            self.latch("it does not take its goal (statusword bit 12)")
        if self.ready and not self.statusword & table.REMOTE:
            self.latch("it does not obey the bus (statusword bit 9); is it operated from its panel?")

    # --- state

    @property
    def unheard(self) -> str:
        """The frame that it has not sent since set-up."""
        if self.beat_ns <= self.set_up_ns:
            return "no heartbeat (1017h)"
        return "" if self.answered_ns > self.set_up_ns else "no TPDO1 (1800h) after a SYNC"

    @property
    def acknowledged(self) -> bool:
        """Whether it acknowledges a set-point."""
        return bool(self.statusword & table.ACKNOWLEDGED)

    @property
    def can_take_goal(self) -> bool:
        """Whether the handshake of the last set-point is over."""
        return not self.controlword & table.NEW_SET_POINT and not self.acknowledged

    @property
    def turning_mode(self) -> int:
        """The mode for velocities; profile position, with the end of the range as goal, if there is none."""
        for mode in (table.CYCLIC_VELOCITY, table.PROFILE_VELOCITY_MODE):
            if mode in self.modes:
                return mode
        return table.PROFILE_POSITION

    def braking(self, accel: int) -> bytes:
        """Returns the data of the frame with its deceleration, and target velocity 0 where that is mapped."""
        return (
            table.BRAKING.layout.pack(accel)
            if self.turning_mode == table.PROFILE_POSITION
            else table.TURNING.layout.pack(accel, 0)
        )

    @property
    def torque(self) -> bool | None:
        return None if self.state_now is None else self.state_now.torque

    def fresh(self, now_ns: int, stale_after_ns: int) -> Sample:
        if self.silent:  # even with a recent measurement, as it is not admitted again yet
            raise self.absence(now_ns)
        return super().fresh(now_ns, stale_after_ns)

    def check_place(self, sample: Sample) -> None:
        """Raises ``DeviceFault`` if it is beyond the drive's own range, to which some modes would drive it at once."""
        place = sample.position
        low, high = self.own_range or (place, place)
        if not low - self.resolution.arrived <= place <= high + self.resolution.arrived:
            end = self.scale.angle_rad(low if place < low else high)
            raise self.fault_error(
                f"it is at {self.scale.angle_rad(place):.3f} rad, outside its own range, which ends at {end:.3f} rad "
                "(607Dh): turn it back by hand, or widen 607Dh"
            )

    def absence(self, now_ns: int) -> DeviceError:
        """Returns the error for a drive that is left out."""
        why = _STOPPED if self.stopped else self.unfit
        return self.fault_error(why) if why else self.silent_error(now_ns)

    def state(self, now_ns: int, stale_after_ns: int) -> MotorState:
        sample = self.fresh(now_ns, stale_after_ns)
        return self.measured(
            sample,
            now_ns,
            load=self.scale.load(sample.effort, table.FULL_TORQUE),
            enabled=self.state_now in {State.ENABLED, State.QUICK_STOP},
            temperature_c=None,
            voltage_v=None,
        )
