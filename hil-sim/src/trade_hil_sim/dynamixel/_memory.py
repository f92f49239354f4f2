"""The control table as memory: what may be read and written where, with indirect addresses followed.

Knows nothing of motion or time; rules that depend on other registers are the servo's.
"""

from collections.abc import Iterable

from ._protocol import ErrorCode
from ._table import RAM_BEGINS, Model, Register

__all__ = ["ControlTable", "Refusal"]


class Refusal(Exception):
    """An instruction the servo does not carry out; the number goes into its answer."""

    def __init__(self, code: ErrorCode, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class ControlTable:
    """The memory of one servo, EEPROM and RAM, at its factory defaults."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._bytes = bytearray(model.ends)
        self._at: list[Register | None] = [None] * model.ends
        for register in model.registers:
            self._at[register.address : register.address + register.size] = [register] * register.size
            self.set(register.name, register.default)

    def get(self, name: str) -> int:
        """A register's value in device units."""
        register = self.model.by_name[name]
        raw = self._bytes[register.address : register.address + register.size]
        return int.from_bytes(raw, "little", signed=register.signed)

    def set(self, name: str, value: int) -> None:
        """Put a value into a register, whatever its access; surplus bits are cut off."""
        register = self.model.by_name[name]
        raw = (value & (1 << 8 * register.size) - 1).to_bytes(register.size, "little")
        self._bytes[register.address : register.address + register.size] = raw

    def restore(self, registers: Iterable[Register]) -> None:
        """Set registers to their factory defaults."""
        for register in registers:
            self.set(register.name, register.default)

    def forget_ram(self) -> None:
        """What happens to the memory at power loss: EEPROM stays, RAM does not."""
        self._bytes[RAM_BEGINS:] = bytes(self.model.ends - RAM_BEGINS)
        self.restore(register for register in self.model.registers if not register.eeprom)

    def read(self, address: int, length: int) -> bytes:
        """Bytes from the table; gaps between registers read as 0.

        Raises:
            Refusal: access error past the end, and where there is no register at all.
        """
        end = address + length
        if length == 0 or end > self.model.ends or not any(self._at[address:end]):
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

    def touched(self, address: int, length: int) -> tuple[str, ...]:
        """Names of the registers in a range, through indirect addresses, in order and once each."""
        inside = range(address, min(address + length, self.model.ends))
        found = (self._at[self._target(at)] for at in inside)
        return tuple(dict.fromkeys(register.name for register in found if register is not None))

    def _target(self, address: int) -> int:
        for bank in self.model.indirect:
            if bank.data_at <= address < bank.data_at + bank.count:
                at = bank.address_at + 2 * (address - bank.data_at)
                return int.from_bytes(self._bytes[at : at + 2], "little")
        return address

    def _whole(self, bytes_at: dict[int, int]) -> list[Register]:
        registers: dict[Register, None] = {}
        for at in bytes_at:
            register = self._at[at]
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
    raw = bytes(bytes_at[register.address + k] for k in range(register.size))
    value = int.from_bytes(raw, "little", signed=register.signed)
    low, high = register.low, register.high
    if (low is not None and value < low) or (high is not None and value > high):
        reason = f"{register.name} ({register.address}) = {value} is outside {low} to {high}"
        raise Refusal(ErrorCode.DATA_RANGE, reason)
    return value
