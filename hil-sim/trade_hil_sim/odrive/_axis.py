"""An axis of an ODrive: its commands, messages, state, errors and watchdog. Time is an argument."""

import struct
from math import inf, isfinite, tau
from typing import Final

from trade_hil_sim.can import Frame, JointDevice
from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.mechanics._device import Controller

from ._motor import Motor
from ._table import ANSWERS, ORDERS, Command, Errors, Result, State

HEARTBEAT_S: Final = 0.1
ESTIMATES_S: Final = 0.01
VOLTS: Final = (12.0, 56.0)
HOTTEST_C: Final = 110
FIRMWARE: Final = (0, 6, 10)
KNOWN: Final = frozenset(map(int, Command))
MOVING: Final = frozenset(
    {
        Command.SET_AXIS_STATE,
        Command.SET_CONTROLLER_MODE,
        Command.SET_INPUT_POS,
        Command.SET_INPUT_VEL,
        Command.SET_INPUT_TORQUE,
    }
)


class Axis(JointDevice):
    """One axis; it is calibrated and idle when created.

    Args:
        device_id: its node, 0 to 62.
        joint: name of the joint, for the log.
        model: what it is called.
        line: its product line: 4 Pro, 5 S1, 6 Micro.
        firmware: its version, three numbers.
        gear: turns of the motor for one turn of the joint.
        turns: where its motor is at first.
        reversed_: whether the joint turns against the motor.
        offset_rad: the joint's angle at 0 turns.
        watchdog_s: ``watchdog_timeout``; None: ``enable_watchdog`` is off.
        t: now, in seconds.
    """

    thing = "an ODrive"
    turn = 1.0
    healthy = (24.0, 35)

    def __init__(
        self,
        device_id: int,
        *,
        joint: str = "",
        model: str = "ODrive S1",
        line: int = 5,
        firmware: tuple[int, ...] = FIRMWARE,
        gear: float = 1.0,
        turns: float = 0.0,
        reversed_: bool = False,
        offset_rad: float = 0.0,
        watchdog_s: float | None = 0.3,
        t: float = 0.0,
    ) -> None:
        self._motor = Motor(turns, t)
        super().__init__(
            device_id,
            self._motor.shaft,
            joint=joint,
            model=model,
            rad_per_unit=(-1 if reversed_ else 1) * tau / gear,
            offset_rad=offset_rad,
        )
        self.watchdog_s = watchdog_s
        self.calibrated = True
        self._line = self._shown_line = line
        self._firmware = firmware
        self._state, self._result = State.IDLE, Result.SUCCESS
        self._errors = self._disarmed_by = 0
        self._lasting = 0
        """Errors that return when they are cleared."""
        self._fed = t
        self._beat_due, self._estimates_due = t + HEARTBEAT_S, t + ESTIMATES_S
        self._plan(t)

    # the bus

    def hear(self, frame: Frame, t: float) -> None:
        """A frame has come."""
        if frame.extended or frame.can_id >> 5 != self.device_id or frame.can_id & 0x1F not in KNOWN:
            return
        self.advance(t)
        self._fed = t
        command = Command(frame.can_id & 0x1F)
        if command in ANSWERS:
            if frame.remote or not frame.data:
                self._tell(command, t)
        elif not frame.remote and command in ORDERS:
            layout = ORDERS[command]
            if len(frame.data) >= layout.size:
                values = layout.unpack(frame.data[: layout.size])
                if all(map(isfinite, values)):
                    self._obey(command, values, frame.data, t)
                else:
                    self.note("refused", t, f"{command.name.lower()}: infinite, or no number")
        self._plan(t)

    def advance(self, t: float) -> None:
        """Run what is due."""
        if self._expires() <= t:
            self.note("watchdog_expired", t)
            self._fail(Errors.WATCHDOG, t)
        if self._estimates_due <= t:
            self._tell(Command.GET_ENCODER_ESTIMATES, t)
            self._estimates_due = max(self._estimates_due, t - ESTIMATES_S / 2) + ESTIMATES_S
        if self._beat_due <= t:
            self._tell(Command.HEARTBEAT, t)
            self._beat_due = max(self._beat_due, t - HEARTBEAT_S / 2) + HEARTBEAT_S
        self._plan(t)

    def _plan(self, t: float) -> None:
        self._note_motion(t)
        self.due = min(self._expires(), self._estimates_due, self._beat_due, self._shaft.rests_at(t))

    def _expires(self) -> float:
        return self._fed + self.watchdog_s if self._armed and self.watchdog_s is not None else inf

    @property
    def _armed(self) -> bool:
        return self._state is not State.IDLE

    # commands

    def _obey(self, command: Command, values: tuple[float, ...], data: bytes, t: float) -> None:
        name = command.name.lower()
        self._journal(name, data, command in MOVING, t)
        match command:
            case Command.ESTOP:
                self._fail(Errors.ESTOP, t)
            case Command.SET_AXIS_STATE:
                self._go_to(int(values[0]), t)
            case Command.CLEAR_ERRORS:
                self._errors = self._lasting
            case Command.REBOOT:
                self._restart(t)
            case _:
                self._motor.command(command, values, t, armed=self._armed)

    def _go_to(self, state: int, t: float) -> None:
        if state == State.IDLE:
            self._disarm(Result.SUCCESS, t)
        elif state != State.CLOSED_LOOP_CONTROL or self._errors:
            self._result = Result.INVALID_STATE
            self.note("refused", t, f"state {state}")
        elif not self.calibrated:
            self._result = Result.NOT_CALIBRATED
            self.note("refused", t, "not calibrated")
        elif not self._armed:
            self._state, self._result = State.CLOSED_LOOP_CONTROL, Result.SUCCESS
            self._disarmed_by = 0
            self._motor.arm(t)
            self.note("torque_on", t)

    def _disarm(self, result: Result, t: float) -> None:
        self._result = result
        if self._armed:
            self._state = State.IDLE
            self._motor.coast(t)
            self.note("torque_off", t)

    def _fail(self, errors: int, t: float) -> None:
        self._errors |= errors
        self.note("error", t, f"{errors:X}h")
        if self._armed:
            self._disarmed_by = errors
            self._disarm(Result.DISARMED, t)

    def _restart(self, t: float) -> None:
        """Reset everything that is not saved; the shaft stays where it is."""
        self._disarm(Result.SUCCESS, t)
        self._errors, self._disarmed_by = self._lasting, 0
        self._motor.forget_settings()
        self.note("booted", t)

    # messages

    def _tell(self, command: Command, t: float) -> None:
        self.send(Frame(self.device_id << 5 | command, self._answer(command, t)), t)

    def _answer(self, command: Command, t: float) -> bytes:
        match command:
            case Command.HEARTBEAT:
                done = not self._moving(t)
                return struct.pack("<IBBBx", self._errors, self._state, self._result, done)
            case Command.GET_VERSION:
                return bytes((2, self._shown_line, 2, 0, *self._firmware, 0))
            case Command.GET_ERROR:
                return struct.pack("<II", self._errors, self._disarmed_by)
            case Command.GET_ENCODER_ESTIMATES:
                return struct.pack("<ff", *self._shown(t))
            case Command.GET_IQ:
                return struct.pack("<ff", *(2 * (self._motor.amperes(t) if self._armed else 0.0,)))
            case Command.GET_TEMPERATURE:
                return struct.pack("<ff", self.temperature_c, self.temperature_c)
            case Command.GET_BUS_VOLTAGE_CURRENT:
                return struct.pack("<ff", self.supply_v, 0.2)
            case _:
                return bytes(8)

    # faults

    def _do_rare(self, command: faults.Command, t: float) -> None:
        match command:
            case faults.Emergency():
                self._lasting |= command.code if command.lasting else 0
                self._fail(command.code, t)
            case _:
                super()._do_rare(command, t)

    def jam(self, on: bool, t: float) -> None:
        """Jam the shaft, or release it."""
        self._motor.jam(on, t)

    def _lose_zero(self, position: float, t: float) -> None:
        self._motor.zero = self._shaft.position(t) - position

    def _position(self, t: float) -> float:
        return self._shaft.position(t) - self._motor.zero

    def _place(self, position: float, t: float) -> None:
        self._motor.place(position, t)
        self.note("placed", t)

    def wrong_model(self, number: int) -> None:
        """Identify as another product line."""
        self._shown_line = number & 0xFF

    def _check_supply(self, t: float) -> None:
        self._lasting = 0
        if self.supply_v < VOLTS[0]:
            self._lasting |= Errors.UNDER_VOLTAGE
        if self.supply_v > VOLTS[1]:
            self._lasting |= Errors.OVER_VOLTAGE
        if self.temperature_c > HOTTEST_C:
            self._lasting |= Errors.INVERTER_TOO_HOT
        if self._lasting & ~self._errors:
            self._fail(self._lasting, t)

    def _restore(self, t: float) -> None:  # noqa: ARG002 - at once
        (self.supply_v, self.temperature_c), self._lasting = self.healthy, 0
        self._shown_line = self._line

    def _controller(self) -> Controller:
        return Controller(
            goal_counts=round(self._motor.goal * self.counts_per_unit),
            torque=self._armed,
            operating_mode=self._motor.control,
            hardware_error=self._errors,
            watchdog=round((self.watchdog_s or 0) * 1e3),
        )
