"""The memory table as memory: live bytes, and those that survive a loss of power.

Independent of motion and time.
"""

from trade_hil_sim.serial._registers import Memory

from ._table import RAM_BEGINS, TABLE_ENDS, Model, Register


class MemoryTable(Memory[Register]):
    """The memory of one servo, at its factory defaults."""

    def __init__(self, model: Model) -> None:
        super().__init__(model.by_name, TABLE_ENDS)
        self.model = model
        self.factory_reset()

    def keep(self, name: str) -> None:
        """Let an EEPROM register's value survive power loss."""
        register = self.model.by_name[name]
        span = slice(register.address, register.address + register.size)
        self._persistent[span] = self._bytes[span]

    def lose_power(self) -> None:
        """EEPROM registers and those of the firmware as kept, the others at their defaults."""
        self.restore(self.model.registers)
        self._bytes[:RAM_BEGINS] = self._persistent[:RAM_BEGINS]
        self.set("torque_limit", self.get("max_torque"))

    def factory_reset(self, spared: tuple[str, ...] = ()) -> None:
        """Set all registers except some to their defaults, permanently."""
        values = {name: self.get(name) for name in spared}
        self.restore(self.model.registers)
        for name, value in values.items():
            self.set(name, value)
        self._persistent = bytearray(self._bytes)

    def read(self, address: int, length: int) -> bytes:
        """Bytes from the table; where there is no register, they are 0."""
        return bytes(self._bytes[address : address + length]).ljust(length, b"\0")

    def plan(self, address: int, data: bytes) -> tuple[dict[str, int], list[str]]:
        """The changes by a write, and the registers that it cannot change: read-only, half, or out of range."""
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
