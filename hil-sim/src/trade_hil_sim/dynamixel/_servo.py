"""One simulated servo: how it answers instructions, and what it does by itself as time passes.

Sources: ROBOTIS e-Manual, the models' pages (control table descriptions), "DYNAMIXEL Protocol 2.0". Where the manual
leaves a choice, the one that is harder on a driver was taken; docs/simulators.md lists them.
"""

from collections.abc import Callable, Iterator
from typing import Final

from trade_hil_sim.mechanics._truth import DeviceState

from ._drive import Drive, Mode
from ._memory import ControlTable, Refusal
from ._models import XL430_W250
from ._protocol import ALERT, ErrorCode
from ._rules import GOALS, WATCHDOG_EXPIRED, HardwareError, check, seed_goals
from ._table import BAUDS, CENTRE, RAD_PER_COUNT, Model, Register

__all__ = ["Emit", "Servo"]

WATCHDOG_UNIT_S: Final = 0.02
RETURN_DELAY_UNIT_S: Final = 2e-6
OVERLOAD_S: Final = 1.0
"""How long it strains against a jam before it gives up: an assumption, the manual does not say."""
BOOT_S: Final = 0.1
"""How long it hears nothing after a reboot: an assumption."""
TICKS: Final = 32_768
CLEAR_MULTI_TURN: Final = bytes([0x01, 0x44, 0x58, 0x4C, 0x22])

Emit = Callable[["Servo", str, float, str], None]


def _nowhere(servo: "Servo", name: str, t: float, detail: str) -> None:
    pass


class Servo:
    """A servo, fresh from the box but for its id, baud rate and position: torque off, position mode.

    Args:
        device_id: 0 to 252.
        model: which control table.
        position_counts: where the shaft stands at the beginning; 2048 is the centre.
        baud: one of the rates register 8 knows.
        joint: name of the joint it drives, for logs.
        reversed_: whether the joint turns against the device.
        offset_rad: joint angle when the device reads its centre.
        t: the time, in seconds, on the clock of all later calls.
        emit: told what happens: servo, event, time, detail.
    """

    def __init__(
        self,
        device_id: int,
        model: Model = XL430_W250,
        *,
        position_counts: float = CENTRE,
        baud: int = 1_000_000,
        joint: str = "",
        reversed_: bool = False,
        offset_rad: float = 0.0,
        t: float = 0.0,
        emit: Emit = _nowhere,
    ) -> None:
        self.model, self.joint, self.emit = model, joint, emit
        self._sign, self._offset_rad = -1 if reversed_ else 1, offset_rad
        self.table = ControlTable(model)
        self.table.set("id", device_id)
        self.table.set("baud_rate", BAUDS.index(baud))
        self.absent = False
        self.drive = Drive(self.table, position_counts, t)
        self._underway = False
        self._registered: tuple[int, bytes] | None = None
        self._heard_at = self._born_at = t
        self._boots_at: float | None = None
        self._strains_since: float | None = None
        self._tick_frozen_at: float | None = None
        self._start_ram(t)

    # what it is

    @property
    def device_id(self) -> int:
        """Its id on the bus, register 7."""
        return self.table.get("id")

    @property
    def baud(self) -> int:
        """Bits per second it listens at, register 8."""
        return BAUDS[self.table.get("baud_rate")]

    @property
    def shadow_id(self) -> int | None:
        """The second id it obeys writes to, register 12, if there is one."""
        shadow = self.table.get("shadow_id")
        return shadow if shadow <= 252 and shadow != self.device_id else None

    @property
    def return_delay_s(self) -> float:
        """Its pause before an answer, register 9."""
        return self.table.get("return_delay_time") * RETURN_DELAY_UNIT_S

    @property
    def status_return_level(self) -> int:
        """What it answers, register 68: 0 pings, 1 reads as well, 2 everything."""
        return self.table.get("status_return_level")

    @property
    def torque(self) -> bool:
        """Whether the motor is on."""
        return self.table.get("torque_enable") == 1

    @property
    def hears(self) -> bool:
        """Whether it is there and awake."""
        return not self.absent and self._boots_at is None

    def error_field(self, code: ErrorCode = ErrorCode.NONE) -> int:
        """The error field of its answer: the number, and the alert bit while a hardware error is latched."""
        return code | (ALERT if self.table.get("hardware_error_status") else 0)

    def counts(self, t: float) -> int:
        """Where the shaft really is, in counts."""
        return round(self.drive.position(t))

    def joint_rad(self, t: float) -> float:
        """The joint's angle where the shaft really is."""
        return self._offset_rad + self._sign * (self.drive.position(t) - CENTRE) * RAD_PER_COUNT

    def state(self, t: float) -> DeviceState:
        """The truth about it, at time `t`."""
        self.advance(t)
        return DeviceState(
            device_id=self.device_id,
            joint=self.joint,
            model=self.model.name,
            position_counts=self.counts(t),
            position_rad=self.joint_rad(t),
            velocity_rad_s=self._sign * self.drive.speed(t) * RAD_PER_COUNT,
            goal_counts=self.table.get("goal_position"),
            torque=self.torque,
            moving=self.drive.moving(t),
            operating_mode=self.table.get("operating_mode"),
            hardware_error=self.table.get("hardware_error_status"),
            watchdog=self.table.get("bus_watchdog"),
            absent=self.absent,
        )

    # time

    def next_due(self) -> float | None:
        """When it will next do something by itself."""
        return min((t for t, _ in self._dues()), default=None)

    def advance(self, t: float) -> None:
        """Let happen what is due by time `t`, in order."""
        while due := min((due for due in self._dues() if due[0] <= t), key=lambda due: due[0], default=None):
            when, happen = due
            happen(when)

    def _dues(self) -> Iterator[tuple[float, Callable[[float], None]]]:
        if self._underway and self.drive.course.final_speed == 0.0:
            yield self.drive.course.ends, self._arrive
        watchdog = self.table.get("bus_watchdog")
        if self.torque and 0 < watchdog < WATCHDOG_EXPIRED:
            yield self._heard_at + watchdog * WATCHDOG_UNIT_S, self._expire
        if self._boots_at is not None:
            yield self._boots_at, self._boot
        if self._strains_since is not None:
            yield self._strains_since + OVERLOAD_S, self._overload

    def _arrive(self, t: float) -> None:
        self._underway = False
        self.emit(self, "at_rest", t, "")

    def _expire(self, t: float) -> None:
        self.table.set("bus_watchdog", WATCHDOG_EXPIRED)
        self.emit(self, "watchdog_expired", t, f"heard nothing since {self._heard_at:.6f}")
        self.drive.stop(t)
        self._note_motion(t)

    def _boot(self, t: float) -> None:
        self._boots_at = None
        self._start_ram(t)
        self.emit(self, "booted", t, "")
        self.set_supply(t)

    def _overload(self, t: float) -> None:
        self._strains_since = None
        self.fail(HardwareError.OVERLOAD, t)

    # instructions; the bus calls heard() for each it could hear, whoever it is for

    def heard(self, t: float) -> None:
        """An instruction went over the bus: that feeds the bus watchdog."""
        self.advance(t)
        self._heard_at = t

    def read(self, address: int, length: int, t: float) -> bytes:
        """Bytes of the control table; raises `Refusal`."""
        tick_at = t if self._tick_frozen_at is None else self._tick_frozen_at
        self.table.set("realtime_tick", int((tick_at - self._born_at) * 1e3) % TICKS)
        self.drive.refresh(t, self.torque)
        return self.table.read(address, length)

    def write(self, address: int, data: bytes, t: float, *, by_shadow_id: bool = False) -> None:
        """Write to the control table, all of it or nothing; raises `Refusal`."""
        changes = self.table.plan(address, data)
        for register, value in changes:
            check(self.table, register, value, by_shadow_id=by_shadow_id)
        # torque last: it sets off for the goal that came with it
        for register, value in sorted(changes, key=lambda change: change[0].name == "torque_enable"):
            self._apply(register, value, t)
        if self.drive.mode.goal in {register.name for register, _ in changes} and self.torque:
            self._set_off(t)

    def reg_write(self, address: int, data: bytes) -> None:
        """Keep a write for later; raises `Refusal` if it could not be carried out now."""
        for register, value in self.table.plan(address, data):
            check(self.table, register, value)
        self._registered = (address, data)
        self.table.set("registered_instruction", 1)

    @property
    def registered(self) -> tuple[int, bytes] | None:
        """The write kept for later, if any: address and data."""
        return self._registered

    def action(self, t: float) -> None:
        """Carry out the write kept; raises `Refusal` if there is none."""
        kept, self._registered = self._registered, None
        self.table.set("registered_instruction", 0)
        if kept is None:
            raise Refusal(ErrorCode.INSTRUCTION, "action without reg write")
        self.write(*kept, t)

    def clear(self, params: bytes, t: float) -> None:
        """Forget whole turns; raises `Refusal` while it moves."""
        if params != CLEAR_MULTI_TURN:
            raise Refusal(ErrorCode.DATA_RANGE, f"clear takes 01 44 58 4C 22, not {params.hex(' ')}")
        if self.drive.moving(t):
            raise Refusal(ErrorCode.RESULT_FAIL, "clear while moving")
        self.drive.wrap(t)
        self.table.set("goal_position", self.counts(t))

    def reboot(self, t: float, event: str = "rebooted") -> None:
        """Lose the RAM area, let go of the shaft, and hear nothing for a moment."""
        self.emit(self, event, t, "")
        self._release(t)
        self.table.set("torque_enable", 0)
        self._boots_at = t + BOOT_S

    def factory_reset(self, option: int, t: float) -> None:
        """Restore the EEPROM: 0xFF all of it, 1 all but the id, 2 all but id and baud rate; then reboot."""
        spared = {0xFF: set[str](), 1: {"id"}, 2: {"id", "baud_rate"}}.get(option)
        if spared is None:
            raise Refusal(ErrorCode.DATA_RANGE, f"factory reset takes 0xFF, 1 or 2, not {option}")
        fresh = (r for r in self.model.registers if r.eeprom and r.name not in spared)
        self.table.restore(fresh)
        self.reboot(t, "factory_reset")

    # faults

    def fail(self, bits: int, t: float) -> None:
        """Latch hardware errors; those named in Shutdown (63) switch the motor off until a reboot."""
        self.table.set("hardware_error_status", self.table.get("hardware_error_status") | bits)
        if bits & self.table.get("shutdown"):
            self.emit(self, "shutdown", t, f"hardware error {bits:#04x}")
            self._torque_off(t)

    def set_supply(self, t: float, *, voltage_v: float | None = None, temperature_c: int | None = None) -> None:
        """Change what it measures of its supply and housing; outside its limits, that is a hardware error."""
        drive, limit = self.drive, self.table.get
        drive.supply_v = drive.supply_v if voltage_v is None else voltage_v
        drive.temperature_c = drive.temperature_c if temperature_c is None else temperature_c
        if not limit("min_voltage_limit") <= drive.supply_v * 10 <= limit("max_voltage_limit"):
            self.fail(HardwareError.VOLTAGE, t)
        if drive.temperature_c > limit("temperature_limit"):
            self.fail(HardwareError.OVERHEATING, t)

    def place(self, position_counts: int, t: float) -> None:
        """Turn the shaft by hand; with torque on it goes back to its goal."""
        self.drive.place(position_counts, t)
        self.emit(self, "placed", t, "")
        self._set_off(t) if self.torque else self._note_motion(t)

    def jam(self, on: bool, t: float) -> None:
        """Hold the shaft fast, or let go of it."""
        if on == self.drive.jammed:
            return
        self.drive.jammed = on
        if on:
            self.drive.place(self.drive.position(t), t)
            self._note_motion(t)
        self._strains_since = t if self.torque and self.drive.strains(t) else None
        if not on and self.torque:
            self._set_off(t)

    def freeze_sensor(self, on: bool, t: float, *, tick: bool = False) -> None:
        """Let the position register, and the realtime tick if asked, stand still, or show the truth again."""
        self.drive.freeze_sensor(t) if on else self.drive.thaw_sensor()
        self._tick_frozen_at = t if on and tick else None

    # inside

    def _apply(self, register: Register, value: int, t: float) -> None:
        match register.name:
            case "torque_enable":
                self._torque_on(t) if value else self._torque_off(t)
            case "operating_mode":
                self._change_mode(value, t)
            case "bus_watchdog":
                if self.table.get("bus_watchdog") == WATCHDOG_EXPIRED:
                    self.emit(self, "watchdog_cleared", t, "")
                self.table.set("bus_watchdog", value)
            case name:
                self.table.set(name, value)
                if name in GOALS and not self.torque and self.table.get("drive_mode") & 8:
                    self._torque_on(t)

    def _torque_on(self, t: float) -> None:
        if self.table.get("hardware_error_status") & self.table.get("shutdown"):
            self.emit(self, "refused", t, "torque stays off after a shutdown, until a reboot")
            return
        if self.torque:
            return
        self._wrap_in_position_mode(t)
        self.table.set("torque_enable", 1)
        self.emit(self, "torque_on", t, "")
        self._set_off(t)

    def _torque_off(self, t: float) -> None:
        if not self.torque:
            return
        self.table.set("torque_enable", 0)
        self.emit(self, "torque_off", t, "")
        self._release(t)

    def _release(self, t: float) -> None:
        self._strains_since = None
        self.drive.stop(t)
        self._note_motion(t)

    def _set_off(self, t: float) -> None:
        if self.table.get("bus_watchdog") == WATCHDOG_EXPIRED:
            return
        self.drive.follow(t)
        self._strains_since = t if self.drive.strains(t) else None
        self._note_motion(t)

    def _note_motion(self, t: float) -> None:
        if not self._underway and self.drive.moving(t):
            self._underway = True
            self.emit(self, "motion_started", t, f"goal position {self.table.get('goal_position')}")
        elif self._underway and not self.drive.moving(t):
            self._arrive(t)

    def _change_mode(self, mode: int, t: float) -> None:
        self.table.set("operating_mode", mode)
        gains = [r for r in self.model.registers if r.name.endswith("_gain")]
        profile = [self.model.by_name["profile_velocity"], self.model.by_name["profile_acceleration"]]
        self.table.restore([*gains, *profile])
        self._wrap_in_position_mode(t)
        seed_goals(self.table, self.counts(t))

    def _wrap_in_position_mode(self, t: float) -> None:
        if self.drive.mode is Mode.POSITION:
            self.drive.wrap(t)

    def _start_ram(self, t: float) -> None:
        self.table.forget_ram()
        self._registered, self._born_at, self._heard_at = None, t, t
        self.drive.wrap(t)
        seed_goals(self.table, self.counts(t))
