"""The control table as memory: checks which reads and writes are allowed, and follows indirect addresses.

Independent of motion and time. Source: ROBOTIS e-Manual, descriptions of the models' control tables.
"""

from typing import Final

from trade_hil_sim.serial._registers import Memory

from ._protocol import ErrorCode
from ._table import EXTENDED_RANGE, RAM_BEGINS, Mode, Model, Register

GOALS: Final = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})
MOTION: Final = GOALS | {"torque_enable"}
"""A write to any of these could start a motion, or switch off torque."""
WATCHDOG_EXPIRED: Final = 255
"""What register 98 shows after its time has run out."""


class HardwareError:
    """Bits of Hardware Error Status, register 70, and of Shutdown, register 63."""

    VOLTAGE: Final = 0x01
    OVERHEATING: Final = 0x04
    ENCODER: Final = 0x08
    SHOCK: Final = 0x10
    OVERLOAD: Final = 0x20


class Refusal(Exception):
    """An instruction the servo does not carry out; the number goes into its answer."""

    def __init__(self, code: ErrorCode, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class ControlTable(Memory[Register]):
    """The memory of one servo, EEPROM and RAM, at its factory defaults."""

    def __init__(self, model: Model) -> None:
        super().__init__(model.by_name, model.ends)
        self.model = model
        self.restore(model.registers)

    def forget_ram(self) -> None:
        """Lose power: EEPROM keeps its values, RAM returns to defaults."""
        self._bytes[RAM_BEGINS:] = bytes(self.model.ends - RAM_BEGINS)
        self.restore(register for register in self.model.registers if not register.eeprom)

    def read(self, address: int, length: int) -> bytes:
        """Bytes from the table; gaps between registers read as 0.

        Raises:
            Refusal: access error past the end, and where there is no register at all.
        """
        end = address + length
        if length == 0 or end > self.model.ends or not any(self._by_address[address:end]):
            raise Refusal(ErrorCode.ACCESS, f"nothing to read at {address}, {length} bytes")
        return bytes(self._bytes[self._target(at)] for at in range(address, end))

    def plan(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        """What writing `data` at `address` would change; changes nothing yet.

        Raises:
            Refusal: undefined, read-only, half a register, or a value outside the register's own range.
        """
        if address + len(data) > self.model.ends:
            raise Refusal(ErrorCode.ACCESS, f"no register at {address}, {len(data)} bytes")
        bytes_at = {self._target(address + k): byte for k, byte in enumerate(data)}
        return [(register, _value(register, bytes_at)) for register in self._whole(bytes_at)]

    def _target(self, address: int) -> int:
        for bank in self.model.indirect:
            if bank.data_at <= address < bank.data_at + bank.count:
                at = bank.address_at + 2 * (address - bank.data_at)
                return int.from_bytes(self._bytes[at : at + 2], "little")
        return address

    def _whole(self, bytes_at: dict[int, int]) -> list[Register]:
        registers: dict[Register, None] = {}
        for at in bytes_at:
            register = self._by_address[at]
            if register is None:
                raise Refusal(ErrorCode.ACCESS, f"no register at {at}")
            if not register.writable:
                raise Refusal(ErrorCode.ACCESS, f"{register.name} ({register.address}) is read-only")
            if not all(k in bytes_at for k in range(register.address, register.address + register.size)):
                reason = f"{register.name} ({register.address}) takes {register.size} bytes"
                raise Refusal(ErrorCode.DATA_LENGTH, reason)
            registers[register] = None
        return list(registers)


def _value(register: Register, bytes_at: dict[int, int]) -> int:
    value = register.decode(bytes(bytes_at[register.address + k] for k in range(register.size)))
    low, high = register.low, register.high
    if (low is not None and value < low) or (high is not None and value > high):
        reason = f"{register.name} ({register.address}) = {value} is outside {low} to {high}"
        raise Refusal(ErrorCode.DATA_RANGE, reason)
    return value


def check(table: ControlTable, register: Register, value: int, *, by_shadow_id: bool = False) -> None:
    """Raise `Refusal` if other registers forbid this write."""
    name = register.name
    if register.eeprom:
        _check_unlocked(table, register, by_shadow_id)
    if table.get("bus_watchdog") == WATCHDOG_EXPIRED and (name in GOALS or (name == "bus_watchdog" and value != 0)):
        raise Refusal(ErrorCode.DATA_RANGE, f"{name}: the bus watchdog has expired; write 0 to register 98 first")
    if name == "operating_mode" and value not in table.model.modes:
        raise Refusal(ErrorCode.DATA_RANGE, f"operating mode {value} is none of {sorted(table.model.modes)}")
    if name in GOALS:
        _check_goal(table, name, value)


def _check_unlocked(table: ControlTable, register: Register, by_shadow_id: bool) -> None:
    if table.get("torque_enable"):
        reason = f"{register.name} ({register.address}) is EEPROM, locked while torque is on"
        raise Refusal(ErrorCode.ACCESS, reason)
    if by_shadow_id:
        raise Refusal(ErrorCode.ACCESS, f"{register.name} ({register.address}) is EEPROM, closed to the secondary id")


def _check_goal(table: ControlTable, name: str, value: int) -> None:
    low, high = _goal_range(table, name)
    if not low <= value <= high:
        raise Refusal(ErrorCode.DATA_LIMIT, f"{name} = {value} is outside {low} to {high}")


def _goal_range(table: ControlTable, name: str) -> tuple[int, int]:
    if name == "goal_position":
        if table.get("operating_mode") == Mode.POSITION:
            return table.get("min_position_limit"), table.get("max_position_limit")
        return -EXTENDED_RANGE, EXTENDED_RANGE
    limit = table.get(name.removeprefix("goal_") + "_limit")
    return -limit, limit


def seed_goals(table: ControlTable, position_counts: int) -> None:
    """Goals that ask for no motion. Outside PWM mode, goal PWM is only the limit of the controller."""
    mode = table.get("operating_mode")
    table.set("goal_position", position_counts)
    table.set("goal_velocity", 0)
    table.set("goal_pwm", 0 if mode == Mode.PWM else table.get("pwm_limit"))
    if "goal_current" in table.model.by_name:
        table.set("goal_current", 0 if mode == Mode.CURRENT else table.get("current_limit"))
