"""A Damiao motor: registers, modes, status and time-out behind its two identifiers. Time is an argument."""

import struct
from math import copysign, inf
from typing import Final

from trade_hil_sim.can import Frame, JointDevice
from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.mechanics._device import Controller
from trade_hil_sim.mechanics._shaft import Shaft

from . import _table as table
from ._protocol import Impedance, decode_mit, encode_feedback
from ._table import MODELS, ORDERS, TARGETS, Mode, Register, Status

QUICK: Final = 400.0
"""The most it accelerates, in rad/s^2: an assumption, as are the two below."""
COAST: Final = 60.0
"""Deceleration by friction without torque, in rad/s^2."""
INERTIA: Final = 0.02
"""Newton metres for one rad/s^2."""
FOLLOW_S: Final = 0.02
"""Time to reach a near set-point, if set-points come often: an assumption."""
SLOWEST_S: Final = 0.2
HARDLY_RAD: Final = 5e-4
"""Below its resolution."""
VOLTS: Final = (15.0, 52.0)
HOTTEST_C: Final = 120
SOFTWARE: Final = 5014
"""Its version of the software, unless a robot file names another one."""


class Motor(JointDevice):
    """One motor; it is disabled when created.

    Args:
        device_id: the id it listens to, 1 to 15; it answers with that id plus 16.
        joint: name of the joint, for the log.
        model: ``DM4310`` or another of `MODELS`.
        software: version of its software, register 14.
        gear: turns of the motor's own shaft for one turn of the joint.
        position_rad: where its shaft is at first.
        reversed_: whether the joint turns against the motor.
        offset_rad: the joint's angle at 0.
        t: now, in seconds.
    """

    thing = "a Damiao motor"

    def __init__(
        self,
        device_id: int,
        *,
        joint: str = "",
        model: str = "DM4310",
        software: int = SOFTWARE,
        gear: float = 1.0,
        position_rad: float = 0.0,
        reversed_: bool = False,
        offset_rad: float = 0.0,
        t: float = 0.0,
    ) -> None:
        super().__init__(
            device_id,
            Shaft(position_rad, t),
            joint=joint,
            model=model,
            rad_per_unit=(-1 if reversed_ else 1) / gear,
            offset_rad=offset_rad,
        )
        self._zero = 0.0
        """Where its shaft was when a command set the zero there."""
        self._goal = position_rad
        self._software = software
        self._registers: dict[int, float] = {}
        self._power_on()
        self._status = Status.DISABLED
        self._lasting: Status | None = None
        """Errors that return when they are cleared."""
        self._fed = t
        self._followed = t
        self._plan(t)

    def _power_on(self) -> None:
        ranges = MODELS[self.model_name]
        self._registers = dict.fromkeys(sorted(table.KNOWN), 0.0) | {
            Register.ACCELERATION: QUICK,
            Register.DECELERATION: -QUICK,
            Register.MASTER_ID: self.device_id + table.MASTER,
            Register.ESC_ID: self.device_id,
            Register.CONTROL_MODE: Mode.MIT,
            Register.SOFTWARE: self._software,
            Register.POSITION_MAX: ranges.position_rad,
            Register.VELOCITY_MAX: ranges.velocity_rad_s,
            Register.TORQUE_MAX: ranges.torque_nm,
        }

    @property
    def ranges(self) -> table.Ranges:
        """The present ranges of its numbers."""
        most = (Register.POSITION_MAX, Register.VELOCITY_MAX, Register.TORQUE_MAX)
        return table.Ranges(*(self._registers[number] for number in most))

    @property
    def mode(self) -> int:
        """The mode: which commands it obeys."""
        return int(self._registers[Register.CONTROL_MODE])

    @property
    def _enabled(self) -> bool:
        return self._status is Status.ENABLED

    # the bus

    def hear(self, frame: Frame, t: float) -> None:
        """A frame has come."""
        if frame.extended or frame.remote or len(frame.data) < 4:
            return
        base, motor = frame.can_id & 0x700, frame.can_id & 0xFF
        about = frame.can_id == table.BROADCAST
        if about and frame.data[:2] != bytes((self.device_id, 0)):
            return
        if not about and (motor != self.device_id or base not in {0, *TARGETS}):
            return
        self.advance(t)
        self._fed = t
        if about:
            self._asked(frame.data, t)
        else:
            self._command(base, frame.data, t)
        self._plan(t)

    def advance(self, t: float) -> None:
        """Run what is due."""
        if self._expires() <= t:
            self.note("watchdog_expired", t)
            self._fail(Status.LOST_COMMUNICATION, t)
        if self._shaft.settles_at is not None and self._shaft.settles_at <= t:
            self._shaft.settle(t, self.ranges.velocity_rad_s, self._registers[Register.ACCELERATION])
        self._plan(t)

    def _plan(self, t: float) -> None:
        self._note_motion(t)
        settles_at = self._shaft.settles_at
        self.due = min(self._expires(), self._shaft.rests_at(t), inf if settles_at is None else settles_at)

    def _expires(self) -> float:
        ticks = self._registers[Register.TIMEOUT]
        return self._fed + ticks / table.TICKS_PER_S if self._enabled and ticks else inf

    # questions

    def _asked(self, data: bytes, t: float) -> None:
        kind, number = data[2], data[3]
        match kind:
            case table.READ if number in self._registers:
                self._answer(kind, number, t)
            case table.WRITE if number in self._registers and len(data) == 8:
                self._write(number, data[4:], t)
                self._answer(kind, number, t)
            case table.REFRESH:
                self._feed_back(t)
            case _:
                pass

    def _answer(self, kind: int, number: int, t: float) -> None:
        value = self._registers[number]
        body = struct.pack("<I", int(value)) if number in table.WHOLE else struct.pack("<f", value)
        data = bytes((self.device_id, 0, kind, number)) + body
        self.send(Frame(int(self._registers[Register.MASTER_ID]), data), t)

    def _write(self, number: int, data: bytes, t: float) -> None:
        self._journal("write_register", data, number == Register.CONTROL_MODE, t, address=number)
        if number not in table.READ_ONLY:
            [self._registers[number]] = struct.unpack("<I" if number in table.WHOLE else "<f", data)

    def _feed_back(self, t: float) -> None:
        data = encode_feedback(
            self._status,
            self.device_id,
            (*self._shown(t), self._torque(t)),
            self.ranges,
            (self.temperature_c, self.temperature_c),
        )
        self.send(Frame(int(self._registers[Register.MASTER_ID]), data), t)

    def _torque(self, t: float) -> float:
        if not self._enabled:
            return 0.0
        if self._shaft.jammed and self._shaft.parted:
            return copysign(self.ranges.torque_nm, self._shaft.behind(t))
        return self._shaft.actual.at(t)[2] * INERTIA

    # commands

    def _command(self, base: int, data: bytes, t: float) -> None:
        if base == 0 and len(data) == 8 and data[:7] == b"\xff" * 7 and data[7] in ORDERS:
            self._ordered(data, t)
        elif base == 0 and len(data) == 8:
            self._target("mit", Mode.MIT, data, t)
        elif base in TARGETS:
            modes = {
                table.POSITION_VELOCITY: Mode.POSITION_VELOCITY,
                table.VELOCITY: Mode.VELOCITY,
                table.FORCE_POSITION: Mode.FORCE_POSITION,
            }
            self._target(TARGETS[base], modes[base], data, t)
        self._feed_back(t)

    def _ordered(self, data: bytes, t: float) -> None:
        name = ORDERS[data[7]]
        self._journal(name, data, name in {"enable", "disable"}, t)
        match name:
            case "enable":
                self._enable(t)
            case "disable":
                self._switch_off(t, Status.DISABLED)
            case "set_zero":
                self._zero = self._shaft.position(t)
                self._goal = 0.0
            case _:
                if self._status not in {Status.DISABLED, Status.ENABLED}:
                    self._status = self._lasting or Status.DISABLED

    def _enable(self, t: float) -> None:
        if self._status not in {Status.DISABLED, Status.LOST_COMMUNICATION}:
            self.note("refused", t, self._status.name)
        elif not self._enabled:
            self._status = Status.ENABLED
            self.note("torque_on", t)
            if self.mode in {Mode.POSITION_VELOCITY, Mode.FORCE_POSITION}:
                self._go(self._goal, self.ranges.velocity_rad_s, t)

    def _switch_off(self, t: float, status: Status) -> None:
        if self._enabled:
            self.note("torque_off", t)
            self._shaft.forget(t)
            self._shaft.spin(t, 0.0, COAST)
        self._status = status

    def _fail(self, status: Status, t: float) -> None:
        self.note("error", t, status.name)
        self._switch_off(t, status)

    def _target(self, name: str, mode: Mode, data: bytes, t: float) -> None:
        if self.mode != mode:
            return
        before = self._goal
        match mode:
            case Mode.MIT:
                self._impede(decode_mit(data, self.ranges), t)
            case Mode.VELOCITY:
                [speed] = struct.unpack("<f", data[:4])
                if self._enabled:
                    self._shaft.spin(t, speed, self._registers[Register.ACCELERATION])
            case Mode.POSITION_VELOCITY:
                self._goal, most = struct.unpack("<ff", data[:8])
                self._follow(abs(most), before, t)
            case _:
                self._goal, speed, _ = struct.unpack("<fHH", data[:8])
                self._follow(speed / 100, before, t)
        if self._goal != before or mode is not Mode.POSITION_VELOCITY:
            self._journal(name, data, True, t)

    def _follow(self, most: float, before: float, t: float) -> None:
        """Pass through near set-points that follow each other, without a stop."""
        period_s, self._followed = max(FOLLOW_S, 2 * (t - self._followed)), t
        if not self._enabled or (self._goal == before and not self._shaft.parted):
            return
        if period_s > SLOWEST_S or abs(self._goal - self._position(t)) > most * period_s:
            self._go(self._goal, most, t)
        else:
            quick = self._registers[Register.ACCELERATION]
            self._shaft.track(t, self._goal + self._zero, period_s, most, quick)

    def _impede(self, wanted: Impedance, t: float) -> None:
        """Move as a MIT command says: a spring pulls to its end at once, else a damper or a torque turns the shaft."""
        if not self._enabled:
            return
        most = self.ranges.velocity_rad_s
        if wanted.stiffness > 0:
            self._goal = wanted.position_rad
            self._go(self._goal, most, t)
        elif wanted.damping > 0:
            self._shaft.spin(t, wanted.velocity_rad_s, QUICK)
        else:
            pull = wanted.torque_nm if abs(wanted.torque_nm) > self.ranges.torque_nm / 1000 else 0.0
            self._shaft.spin(t, copysign(most, pull) if pull else 0.0, abs(pull) / INERTIA or COAST)

    def _go(self, goal: float, most: float, t: float) -> None:
        if abs(goal - self._position(t)) < HARDLY_RAD and not self._shaft.moving(t) and not self._shaft.parted:
            return  # friction holds it
        self._shaft.go(t, goal + self._zero, most, self._registers[Register.ACCELERATION])

    # faults

    def _do_rare(self, command: faults.Command, t: float) -> None:
        match command:
            case faults.HardwareFault():
                self._fail(Status(command.bits), t)
            case _:
                super()._do_rare(command, t)

    def jam(self, on: bool, t: float) -> None:
        """Jam the shaft, or release it."""
        self._shaft.jam(on, t)

    def _place(self, position: float, t: float) -> None:
        self._shaft.place(position + self._zero, t)
        self._shaft.forget(t)
        self.note("placed", t)

    def wrong_model(self, number: int) -> None:
        """Take the range of positions of another model."""
        self._registers[Register.POSITION_MAX] = float(number)

    def _lose_zero(self, position: float, t: float) -> None:
        self._zero = self._shaft.position(t) - position

    def _restart(self, t: float) -> None:
        self._switch_off(t, Status.DISABLED)
        self._power_on()

    def set_supply(self, t: float, *, voltage_v: float | None = None, temperature_c: int | None = None) -> None:
        """Change what it measures, and end an earlier lasting error; it fails if a value is outside its limits."""
        self._lasting = None
        if temperature_c is not None:
            self.temperature_c = temperature_c
            self._lasting = Status.ROTOR_TOO_HOT if temperature_c > HOTTEST_C else None
        if voltage_v is not None and not VOLTS[0] <= voltage_v <= VOLTS[1]:
            self._lasting = Status.UNDER_VOLTAGE if voltage_v < VOLTS[0] else Status.OVER_VOLTAGE
        if self._lasting is not None:
            self._fail(self._lasting, t)

    def _restore(self, t: float) -> None:  # noqa: ARG002 - at once
        (_, self.temperature_c), self._lasting = self.healthy, None
        self._registers[Register.POSITION_MAX] = MODELS[self.model_name].position_rad

    def _unjam(self, t: float) -> None:
        held = self._shaft.jammed
        self.jam(False, t)
        if held and self._enabled and self.mode == Mode.POSITION_VELOCITY:
            self._go(self._goal, self.ranges.velocity_rad_s, t)

    # the truth

    def _position(self, t: float) -> float:
        return self._shaft.position(t) - self._zero

    def _controller(self) -> Controller:
        return Controller(
            goal_counts=round(self._goal * self.counts_per_unit),
            torque=self._enabled,
            operating_mode=self.mode,
            hardware_error=int(self._status) if self._status >= Status.OVER_VOLTAGE else 0,
            watchdog=round(self._registers[Register.TIMEOUT]),
        )
