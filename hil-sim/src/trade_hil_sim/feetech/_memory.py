"""The memory table as memory: live bytes, and those that are kept without power.

Knows nothing of motion or time.
"""

from ._table import EEPROM_BEGINS, RAM_BEGINS, TABLE_ENDS, Model, Register

__all__ = ["Memory"]


class Memory:
    """The memory of one servo, at its factory defaults."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._live = bytearray(TABLE_ENDS)
        self._at: list[Register | None] = [None] * TABLE_ENDS
        for register in model.registers:
            self._at[register.address : register.address + register.size] = [register] * register.size
        self.factory_reset()

    def get(self, name: str) -> int:
        """A register's value in device units."""
        register = self.model.by_name[name]
        return register.decode(bytes(self._live[register.address : register.address + register.size]))

    def set(self, name: str, value: int) -> None:
        """Put a value into a register, whatever its access; an EEPROM register's is not kept."""
        register = self.model.by_name[name]
        self._live[register.address : register.address + register.size] = register.encode(value)

    def keep(self, name: str) -> None:
        """Have an EEPROM register's value survive power loss."""
        register = self.model.by_name[name]
        span = slice(register.address, register.address + register.size)
        self._kept[span] = self._live[span]

    def lose_power(self) -> None:
        """EEPROM registers as kept, the others at their defaults."""
        self._restore()
        self._live[EEPROM_BEGINS:RAM_BEGINS] = self._kept[EEPROM_BEGINS:RAM_BEGINS]
        self.set("torque_limit", self.get("max_torque"))

    def factory_reset(self, spared: tuple[str, ...] = ()) -> None:
        """All registers at their defaults, for good, but for some."""
        values = {name: self.get(name) for name in spared}
        self._restore()
        for name, value in values.items():
            self.set(name, value)
        self._kept = bytearray(self._live)

    def _restore(self) -> None:
        for register in self.model.registers:
            self.set(register.name, register.default)

    def read(self, address: int, length: int) -> bytes:
        """Bytes from the table; where there is no register, they are 0."""
        return bytes(self._live[address : address + length]).ljust(length, b"\0")

    def touched(self, address: int, length: int) -> tuple[str, ...]:
        """Names of the registers in a range, in order."""
        found = self._at[address : min(address + length, TABLE_ENDS)]
        return tuple(dict.fromkeys(register.name for register in found if register is not None))

    def plan(self, address: int, data: bytes) -> tuple[dict[str, int], list[str]]:
        """What writing bytes at an address changes, and what it leaves as it is: read-only, half, or out of range."""
        changes: dict[str, int] = {}
        refused: list[str] = []
        for name in self.touched(address, len(data)):
            register = self.model.by_name[name]
            at = register.address - address
            raw = data[at : at + register.size] if at >= 0 else b""
            value = register.decode(raw)
            whole = len(raw) == register.size
            if whole and register.writable and (register.low or 0) <= value <= (register.high or 0):
                changes[name] = value
            else:
                refused.append(name)
        return changes, refused
