"""One simulated servo: its answers to instructions, and its behaviour over time.

Sources: ROBOTIS e-Manual, the models' pages (control table descriptions), "DYNAMIXEL Protocol 2.0". Where the manual
leaves a choice, the one that is harder on a driver was taken; docs/simulators.md lists them.
"""

from collections.abc import Callable, Iterator
from typing import Final

from trade_hil_sim.mechanics._device import Controller, Emit, unheard
from trade_hil_sim.serial._servo import CENTRE, ServoModel

from ._memory import GOALS, WATCHDOG_EXPIRED, ControlTable, HardwareError, Refusal, check, seed_goals
from ._models import XL430_W250
from ._protocol import ALERT, ErrorCode
from ._shaft import Shaft
from ._table import BAUDS, Mode, Model, Register

WATCHDOG_UNIT_S: Final = 0.02
TICKS: Final = 32_768
CLEAR_MULTI_TURN: Final = bytes([0x01, 0x44, 0x58, 0x4C, 0x22])


class Servo(ServoModel[ControlTable, Shaft]):
    """A servo with factory settings except its id, baud rate and position: torque off, position mode.

    Args:
        device_id: 0 to 252.
        model: which control table.
        position_counts: the initial position of the shaft; 2048 is the centre.
        baud: one of the rates register 8 knows.
        joint: name of the joint it drives, for logs.
        reversed_: whether the joint turns against the device.
        offset_rad: joint angle when the device reads its centre.
        t: the time, in seconds, on the clock of all later calls.
        emit: called with each event.
    """

    firmware = ("firmware_version",)

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
        emit: Emit = unheard,
    ) -> None:
        memory = ControlTable(model)
        memory.set("id", device_id)
        memory.set("baud_rate", BAUDS.index(baud))
        super().__init__(
            memory,
            Shaft(memory, position_counts, t),
            model=model.name,
            supply_v=model.supply_v,
            joint=joint,
            reversed_=reversed_,
            offset_rad=offset_rad,
            emit=emit,
        )
        self.model, self.thing = model, f"an {model.name}"
        self._heard_at = self._born_at = t
        self._tick_frozen_at: float | None = None
        self._start_ram(t)

    # properties

    @property
    def baud(self) -> int:
        """Bits per second it listens at, register 8."""
        return BAUDS[self.memory.get("baud_rate")]

    @property
    def shadow_id(self) -> int | None:
        """The second id it obeys writes to, register 12, if there is one."""
        shadow = self.memory.get("shadow_id")
        return shadow if shadow <= 252 and shadow != self.device_id else None

    @property
    def status_return_level(self) -> int:
        """Status return level, register 68: 0 pings, 1 reads as well, 2 everything."""
        return self.memory.get("status_return_level")

    def error_field(self, code: ErrorCode = ErrorCode.NONE) -> int:
        """The error field of its answer: the number, and the alert bit while a hardware error is latched."""
        return code | (ALERT if self.memory.get("hardware_error_status") else 0)

    def _controller(self) -> Controller:
        return Controller(
            goal_counts=self.memory.get("goal_position"),
            torque=self.torque,
            operating_mode=self.memory.get("operating_mode"),
            hardware_error=self.memory.get("hardware_error_status"),
            watchdog=self.memory.get("bus_watchdog"),
        )

    # time

    def _dues(self) -> Iterator[tuple[float, Callable[[float], None]]]:
        yield from super()._dues()
        watchdog = self.memory.get("bus_watchdog")
        if self.torque and 0 < watchdog < WATCHDOG_EXPIRED:
            yield self._heard_at + watchdog * WATCHDOG_UNIT_S, self._expire

    def _expire(self, t: float) -> None:
        self.memory.set("bus_watchdog", WATCHDOG_EXPIRED)
        self.note("watchdog_expired", t, f"heard nothing since {self._heard_at:.6f}")
        self.shaft.stop(t)
        self._note_motion(t)

    def _boot(self, t: float) -> None:
        super()._boot(t)
        self._check_supply(t)

    # instructions; the bus calls heard() for each one on the wire, whichever device it addresses

    def heard(self, t: float) -> None:
        """An instruction was on the bus: reset the bus watchdog."""
        self.advance(t)
        self._heard_at = t

    def read(self, address: int, length: int, t: float) -> bytes:
        """Bytes of the control table; raises `Refusal`."""
        tick_at = t if self._tick_frozen_at is None else self._tick_frozen_at
        self.memory.set("realtime_tick", int((tick_at - self._born_at) * 1e3) % TICKS)
        self.memory.set("present_input_voltage", round(self.supply_v * 10))
        self.memory.set("present_temperature", self.temperature_c)
        self.shaft.refresh(t, self.torque)
        return self.memory.read(address, length)

    def write(self, address: int, data: bytes, t: float, *, by_shadow_id: bool = False) -> None:
        """Write to the control table, completely or not at all; raises `Refusal`."""
        changes = self.memory.plan(address, data)
        for register, value in changes:
            check(self.memory, register, value, by_shadow_id=by_shadow_id)
        # torque last: the motion starts toward the goal of the same write
        for register, value in sorted(changes, key=lambda change: change[0].name == "torque_enable"):
            self._apply(register, value, t)
        if self.shaft.mode.goal in {register.name for register, _ in changes} and self.torque:
            self._set_off(t)

    def reg_write(self, address: int, data: bytes) -> None:
        """Keep a write for later; raises `Refusal` if it could not be carried out now."""
        for register, value in self.memory.plan(address, data):
            check(self.memory, register, value)
        self._registered = (address, data)
        self.memory.set("registered_instruction", 1)

    def action(self, t: float) -> None:
        """Carry out the write kept; raises `Refusal` if there is none."""
        kept, self._registered = self._registered, None
        self.memory.set("registered_instruction", 0)
        if kept is None:
            raise Refusal(ErrorCode.INSTRUCTION, "action without reg write")
        self.write(*kept, t)

    def clear(self, params: bytes, t: float) -> None:
        """Clear whole turns; raises `Refusal` while it moves."""
        if params != CLEAR_MULTI_TURN:
            raise Refusal(ErrorCode.DATA_RANGE, f"clear takes 01 44 58 4C 22, not {params.hex(' ')}")
        if self.shaft.moving(t):
            raise Refusal(ErrorCode.RESULT_FAIL, "clear while moving")
        self.shaft.wrap(t)
        self.memory.set("goal_position", self.counts(t))

    def factory_reset(self, option: int, t: float) -> None:
        """Restore the EEPROM: 0xFF all of it, 1 all but the id, 2 all but id and baud rate; then reboot."""
        spared = {0xFF: set[str](), 1: {"id"}, 2: {"id", "baud_rate"}}.get(option)
        if spared is None:
            raise Refusal(ErrorCode.DATA_RANGE, f"factory reset takes 0xFF, 1 or 2, not {option}")
        fresh = (r for r in self.model.registers if r.eeprom and r.writable and r.name not in spared)
        self.memory.restore(fresh)
        self.reboot(t, "factory_reset")

    # faults

    def fail(self, bits: int, t: float) -> None:
        """Latch hardware errors; those named in Shutdown (63) switch the motor off until a reboot."""
        self.memory.set("hardware_error_status", self.memory.get("hardware_error_status") | bits)
        if bits & self.memory.get("shutdown"):
            self.note("shutdown", t, f"hardware error {bits:#04x}")
            self._torque_off(t)

    def _check_supply(self, t: float) -> None:
        limit = self.memory.get
        if not limit("min_voltage_limit") <= self.supply_v * 10 <= limit("max_voltage_limit"):
            self.fail(HardwareError.VOLTAGE, t)
        if self.temperature_c > limit("temperature_limit"):
            self.fail(HardwareError.OVERHEATING, t)

    def freeze(self, on: bool, t: float, *, tick: bool = False) -> None:
        """Freeze the position register, and the realtime tick if asked, or show the truth again."""
        super().freeze(on, t, tick=tick)
        self._tick_frozen_at = t if on and tick else None

    # inside

    def _apply(self, register: Register, value: int, t: float) -> None:
        match register.name:
            case "torque_enable":
                self._torque_on(t) if value else self._torque_off(t)
            case "operating_mode":
                self._change_mode(value, t)
            case "bus_watchdog":
                if self.memory.get("bus_watchdog") == WATCHDOG_EXPIRED:
                    self.note("watchdog_cleared", t)
                self.memory.set("bus_watchdog", value)
            case name:
                self.memory.set(name, value)
                if name in GOALS and not self.torque and self.memory.get("drive_mode") & 8:
                    self._torque_on(t)

    def _torque_on(self, t: float) -> None:
        if self.memory.get("hardware_error_status") & self.memory.get("shutdown"):
            self.note("refused", t, "torque stays off after a shutdown, until a reboot")
            return
        if self.torque:
            return
        self._wrap_in_position_mode(t)
        self.memory.set("torque_enable", 1)
        self.note("torque_on", t)
        self._set_off(t)

    def _torque_off(self, t: float) -> None:
        if not self.torque:
            return
        self.memory.set("torque_enable", 0)
        self.note("torque_off", t)
        self._release(t)

    def _set_off(self, t: float) -> None:
        if self.memory.get("bus_watchdog") == WATCHDOG_EXPIRED:
            return
        self.shaft.follow(t)
        self._strains_since = t if self.shaft.strains(t) else None
        self._note_motion(t)

    def _change_mode(self, mode: int, t: float) -> None:
        self.memory.set("operating_mode", mode)
        gains = [r for r in self.model.registers if r.name.endswith("_gain")]
        profile = [self.model.by_name["profile_velocity"], self.model.by_name["profile_acceleration"]]
        self.memory.restore([*gains, *profile])
        self._wrap_in_position_mode(t)
        seed_goals(self.memory, self.counts(t))

    def _wrap_in_position_mode(self, t: float) -> None:
        if self.shaft.mode is Mode.POSITION:
            self.shaft.wrap(t)

    def _start_ram(self, t: float) -> None:
        self.memory.forget_ram()
        self._registered, self._born_at, self._heard_at = None, t, t
        self.shaft.wrap(t)
        seed_goals(self.memory, self.counts(t))
