"""An axis of an ODrive: what it is told, what it tells, its state, its errors and its watchdog. Time is an argument."""

import struct
from collections.abc import Callable
from math import inf, isfinite, tau
from typing import Final

from trade_hil_sim.can import Frame
from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import Entry
from trade_hil_sim.mechanics._truth import DeviceState

from ._motor import Motor
from ._table import ANSWERS, ORDERS, Command, Errors, Result, State

__all__ = ["COUNTS_PER_TURN", "Axis"]

COUNTS_PER_TURN: Final = 1000
"""Of its motor, in the log and in orders: an ODrive itself tells turns."""
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


class Axis:
    """One axis; it is calibrated and idle when made.

    Args:
        device_id: its node, 0 to 62.
        joint: name of the joint, for the log.
        model: what it is called.
        line: its product line: 4 Pro, 5 S1, 6 Micro.
        gear: turns of the motor for one turn of the joint.
        turns: where its motor is at first.
        reversed_: whether the joint turns against the motor.
        offset_rad: the joint's angle at 0 turns.
        watchdog_s: ``watchdog_timeout``; None: ``enable_watchdog`` is off.
        t: now, in seconds.
    """

    def __init__(
        self,
        device_id: int,
        *,
        joint: str = "",
        model: str = "ODrive S1",
        line: int = 5,
        gear: float = 1.0,
        turns: float = 0.0,
        reversed_: bool = False,
        offset_rad: float = 0.0,
        watchdog_s: float | None = 0.3,
        t: float = 0.0,
    ) -> None:
        self.device_id, self.joint, self.model = device_id, joint, model
        self.send: Callable[[Frame, float], None] = lambda frame, t: None  # noqa: ARG005 - the bus sets it
        self.emit: Callable[[Entry], None] = lambda entry: None  # noqa: ARG005 - the bus sets it
        self.watchdog_s = watchdog_s
        self.calibrated = True
        self._rad_per_turn = (-1 if reversed_ else 1) * tau / gear
        self._offset_rad = offset_rad
        self._line = self._shown_line = line
        self._motor = Motor(turns, t)
        self._state, self._result = State.IDLE, Result.SUCCESS
        self._errors = self._disarmed_by = 0
        self._lasting = 0
        """Errors that come back when they are cleared."""
        self._volts, self._celsius = 24.0, 35.0
        self._frozen: tuple[float, float] | None = None
        self._fed = t
        self._beat_due, self._estimates_due = t + HEARTBEAT_S, t + ESTIMATES_S
        self._underway = False
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
                    self._log("refused", t, f"{command.name.lower()}: infinite, or no number")
        self._plan(t)

    def advance(self, t: float) -> None:
        """Do what is due by itself."""
        if self._expires() <= t:
            self._log("watchdog_expired", t)
            self._fail(Errors.WATCHDOG, t)
        if self._estimates_due <= t:
            self._tell(Command.GET_ENCODER_ESTIMATES, t)
            self._estimates_due = max(self._estimates_due, t - ESTIMATES_S / 2) + ESTIMATES_S
        if self._beat_due <= t:
            self._tell(Command.HEARTBEAT, t)
            self._beat_due = max(self._beat_due, t - HEARTBEAT_S / 2) + HEARTBEAT_S
        self._plan(t)

    def _plan(self, t: float) -> None:
        """Log what is new, and say when to come again."""
        moving = self._motor.moving(t)
        if moving != self._underway:
            self._underway = moving
            self._log("motion_started" if moving else "at_rest", t)
        self.due = min(self._expires(), self._estimates_due, self._beat_due, self._motor.rests(t))

    def _expires(self) -> float:
        return self._fed + self.watchdog_s if self._armed and self.watchdog_s is not None else inf

    @property
    def _armed(self) -> bool:
        return self._state is not State.IDLE

    # what it is told

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
                self._reboot(t)
            case _:
                self._motor.told(command, values, t, armed=self._armed)

    def _go_to(self, state: int, t: float) -> None:
        if state == State.IDLE:
            self._disarm(Result.SUCCESS, t)
        elif state != State.CLOSED_LOOP_CONTROL or self._errors:
            self._result = Result.INVALID_STATE
            self._log("refused", t, f"state {state}")
        elif not self.calibrated:
            self._result = Result.NOT_CALIBRATED
            self._log("refused", t, "not calibrated")
        elif not self._armed:
            self._state, self._result = State.CLOSED_LOOP_CONTROL, Result.SUCCESS
            self._disarmed_by = 0
            self._motor.arm(t)
            self._log("torque_on", t)

    def _disarm(self, result: Result, t: float) -> None:
        self._result = result
        if self._armed:
            self._state = State.IDLE
            self._motor.coast(t)
            self._log("torque_off", t)

    def _fail(self, errors: int, t: float) -> None:
        self._errors |= errors
        self._log("error", t, f"{errors:X}h")
        if self._armed:
            self._disarmed_by = errors
            self._disarm(Result.DISARMED, t)

    def _reboot(self, t: float) -> None:
        """All that is not saved is as it was made; the shaft stays where it is."""
        self._disarm(Result.SUCCESS, t)
        self._errors, self._disarmed_by = self._lasting, 0
        self._motor.forget_settings()
        self._log("booted", t)

    # what it tells

    def _tell(self, command: Command, t: float) -> None:
        self.send(Frame(self.device_id << 5 | command, self._answer(command, t)), t)

    def _answer(self, command: Command, t: float) -> bytes:
        match command:
            case Command.HEARTBEAT:
                done = not self._motor.moving(t)
                return struct.pack("<IBBBx", self._errors, self._state, self._result, done)
            case Command.GET_VERSION:
                return bytes((2, self._shown_line, 2, 0, *FIRMWARE, 0))
            case Command.GET_ERROR:
                return struct.pack("<II", self._errors, self._disarmed_by)
            case Command.GET_ENCODER_ESTIMATES:
                place = (self._motor.turns(t), self._motor.speed(t)) if self._frozen is None else self._frozen
                return struct.pack("<ff", *place)
            case Command.GET_IQ:
                return struct.pack("<ff", *(2 * (self._motor.amperes(t) if self._armed else 0.0,)))
            case Command.GET_TEMPERATURE:
                return struct.pack("<ff", self._celsius, self._celsius)
            case Command.GET_BUS_VOLTAGE_CURRENT:
                return struct.pack("<ff", self._volts, 0.2)
            case _:
                return bytes(8)

    # faults

    def do(self, command: faults.Command, t: float) -> None:
        """Carry out a fault or an order; raises `SimulationError` for what it has not got."""
        self.advance(t)
        match command:
            case faults.Freeze():
                self._frozen = (self._motor.turns(t), 0.0) if command.on else None
            case faults.Jam():
                self._motor.jam(command.on, t)
            case faults.Place():
                self._motor.place(command.counts / COUNTS_PER_TURN, t)
                self._log("placed", t)
            case faults.WrongModel():
                self._shown_line = command.number & 0xFF
            case faults.BrownOut():
                self._log("brown_out", t)
                self._reboot(t)
            case faults.Emergency():
                self._lasting |= command.code if command.lasting else 0
                self._fail(command.code, t)
            case faults.Supply():
                self._supply(command, t)
            case faults.BusOff():
                self._log("bus_off" if command.on else "restarted", t)
            case _:
                raise SimulationError(f"{type(command).__name__} is nothing an ODrive can have")
        self._plan(t)

    def _supply(self, command: faults.Supply, t: float) -> None:
        self._volts = self._volts if command.voltage_v is None else command.voltage_v
        self._celsius = self._celsius if command.temperature_c is None else command.temperature_c
        self._lasting = 0
        if self._volts < VOLTS[0]:
            self._lasting |= Errors.UNDER_VOLTAGE
        if self._volts > VOLTS[1]:
            self._lasting |= Errors.OVER_VOLTAGE
        if self._celsius > HOTTEST_C:
            self._lasting |= Errors.INVERTER_TOO_HOT
        if self._lasting & ~self._errors:
            self._fail(self._lasting, t)

    def heal(self, t: float) -> None:
        """End every fault of sensors and shaft; errors stay until they are cleared."""
        self.advance(t)
        self._frozen, self._volts, self._celsius, self._lasting = None, 24.0, 35.0, 0
        self._shown_line = self._line
        self._motor.jam(False, t)
        self._plan(t)

    # the truth

    def _place(self, t: float) -> tuple[int, float]:
        turns = self._motor.turns(t)
        return round(turns * COUNTS_PER_TURN), self._offset_rad + turns * self._rad_per_turn

    def _log(self, name: str, t: float, detail: str = "") -> None:
        counts, angle_rad = self._place(t)
        self.emit(
            Entry(
                t,
                "",
                "event",
                name,
                self.device_id,
                joint=self.joint,
                position_counts=counts,
                position_rad=angle_rad,
                detail=detail,
            )
        )

    def _journal(self, name: str, data: bytes, moves: bool, t: float) -> None:
        entry = Entry(t, "", "instruction", name, self.device_id, joint=self.joint, hex=data.hex(), moves=moves)
        self.emit(entry)

    def state(self, t: float) -> DeviceState:
        """The truth about it."""
        self.advance(t)
        counts, angle_rad = self._place(t)
        return DeviceState(
            device_id=self.device_id,
            joint=self.joint,
            model=self.model,
            position_counts=counts,
            position_rad=angle_rad,
            velocity_rad_s=self._motor.speed(t) * self._rad_per_turn,
            goal_counts=round(self._motor.goal * COUNTS_PER_TURN),
            torque=self._armed,
            moving=self._motor.moving(t),
            operating_mode=self._motor.control,
            hardware_error=self._errors,
            watchdog=round((self.watchdog_s or 0) * 1e3),
            absent=False,
        )
