"""Tables of registers, and the memory of a servo that has one."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar


class Access(Enum):
    """Who may change a register."""

    READ = "R"
    WRITE = "RW"


@dataclass(frozen=True, slots=True)
class Register(ABC):
    """One item of a table, in the device's own units."""

    address: int
    size: int
    name: str
    access: Access = Access.WRITE
    default: int = 0
    low: int | None = None
    high: int | None = None

    @property
    @abstractmethod
    def eeprom(self) -> bool:
        """Whether it can survive a loss of power."""

    @property
    def writable(self) -> bool:
        """Whether an instruction may change it."""
        return self.access is Access.WRITE

    @abstractmethod
    def decode(self, raw: bytes) -> int:
        """The value of its bytes."""

    @abstractmethod
    def encode(self, value: int) -> bytes:
        """Its bytes. A value that is too large is cut off or limited, as the device does."""


_Register = TypeVar("_Register", bound=Register)
_Register_co = TypeVar("_Register_co", bound=Register, covariant=True)


@dataclass(frozen=True, slots=True)
class Model(Generic[_Register]):
    """One kind of servo."""

    name: str
    number: int
    registers: tuple[_Register, ...]
    supply_v: float
    by_name: Mapping[str, _Register] = field(init=False)

    def __post_init__(self) -> None:
        """Index the registers."""
        object.__setattr__(self, "by_name", {register.name: register for register in self.registers})


class Memory(Generic[_Register_co]):
    """The memory of one servo.

    Args:
        registers: by name.
        ends: the address behind the last one.
    """

    def __init__(self, registers: Mapping[str, _Register_co], ends: int) -> None:
        self._by_name = registers
        self._bytes = bytearray(ends)
        self._by_address: list[_Register_co | None] = [None] * ends
        for register in registers.values():
            self._by_address[register.address : register.address + register.size] = [register] * register.size

    def get(self, name: str) -> int:
        """A register's value in device units."""
        register = self._by_name[name]
        return register.decode(bytes(self._bytes[register.address : register.address + register.size]))

    def set(self, name: str, value: int) -> None:
        """Put a value into a register, whatever its access."""
        register = self._by_name[name]
        self._bytes[register.address : register.address + register.size] = register.encode(value)

    def keep(self, name: str) -> None:
        """Let a register's value survive power loss; for memories that do not do that by themselves."""

    def restore(self, registers: Iterable[Register]) -> None:
        """Set registers to their factory defaults."""
        for register in registers:
            self.set(register.name, register.default)

    def touched(self, address: int, length: int) -> tuple[str, ...]:
        """Names of the registers in a range, in order and once each."""
        inside = range(address, min(address + length, len(self._by_address)))
        found = (self._by_address[self._target(at)] for at in inside)
        return tuple(dict.fromkeys(register.name for register in found if register is not None))

    def _target(self, address: int) -> int:
        """The byte that an address refers to."""
        return address
