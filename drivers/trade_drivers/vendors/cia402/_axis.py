"""The state of one drive on the bus thread: its last frames, and faults that forbid motion."""

from collections.abc import Sequence
from enum import Enum, auto
from struct import error as BadLength  # noqa: N812 - what unpacking raises for another number of bytes
from typing import Final

from trade.errors import DeviceError
from trade_drivers.interfaces._motion import MotorState
from trade_drivers.joints import Sample
from trade_drivers.joints.can import MotorAxis, resolution_of
from trade_drivers.vendors.cia402 import _machine as machine
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._machine import State, state_of
from trade_drivers.vendors.cia402._net import emergency_text
from trade_drivers.vendors.cia402._stream import Following, Turning
from trade_robotfile import Joint

_FAULTS: Final = (State.FAULT, State.FAULT_REACTION)
_SOME_FAULT: Final = "it reports a fault"
_STOPPED: Final = "network management has stopped it: it answers nothing until it is taken back"
_ACKNOWLEDGE_NS: Final = 250_000_000
"""The time allowed for a drive to accept a set-point."""


class Stage(Enum):
    """The stages of a drive's admission to the cycle, described in ``Admission``."""

    AWAY = auto()
    LOOKED_OVER = auto()
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

    def _lose(self, why: str, now_ns: int) -> None:
        if self.ready:
            self.latch(why)
        self.forget(now_ns)

    def forget(self, now_ns: int) -> None:
        """Leaves it out until it is checked again, which may be immediately."""
        super().forget(now_ns)
        self.stage, self.probe_at_ns = Stage.AWAY, now_ns
        self.controlword = self.raised_ns = 0
        self.entered, self.stream = 0, None

    def be_awaited(self, now_ns: int) -> None:
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
        if self.ready and not self.statusword & machine.REMOTE:
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
        return bool(self.statusword & machine.ACKNOWLEDGED)

    @property
    def can_take_goal(self) -> bool:
        """Whether the handshake of the last set-point is over."""
        return not self.controlword & machine.NEW_SET_POINT and not self.acknowledged

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
            raise self.faulty(
                f"it is at {self.scale.angle_rad(place):.3f} rad, outside its own range, which ends at {end:.3f} rad "
                "(607Dh): turn it back by hand, or widen 607Dh"
            )

    def absence(self, now_ns: int) -> DeviceError:
        """Returns the error for a drive that is left out."""
        why = _STOPPED if self.stopped else self.unfit
        return self.faulty(why) if why else self.deaf(now_ns)

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
