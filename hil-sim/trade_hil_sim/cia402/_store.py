"""The values of the object dictionary, and the abort codes for invalid SDO requests."""

from collections.abc import Iterable
from enum import IntEnum

from ._objects import Object
from ._units import unit_in_counts


class AbortCode(IntEnum):
    """Why an SDO transfer was refused (CiA 301, table 22)."""

    TOGGLE = 0x0503_0000
    UNKNOWN_COMMAND = 0x0504_0001
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_TOO_LONG = 0x0604_0042
    LENGTH = 0x0607_0010
    TOO_LONG = 0x0607_0012
    TOO_SHORT = 0x0607_0013
    NO_SUBINDEX = 0x0609_0011
    VALUE = 0x0609_0030
    CANNOT_STORE = 0x0800_0020
    DEVICE_STATE = 0x0800_0022


class Abort(Exception):
    """An SDO transfer is refused."""

    def __init__(self, code: AbortCode) -> None:
        super().__init__(f"{code.name} ({code:#010x})")
        self.code = code


class Store:
    """Values of objects, by address and by name.

    Args:
        objects: of the dictionary.
        counts_per_rev: counts of a position for one turn of the motor.
    """

    def __init__(self, objects: Iterable[Object], counts_per_rev: float = 4096.0) -> None:
        self._objects = dict[tuple[int, int], Object]()
        self._counts_per_rev = counts_per_rev
        self._values: dict[str, int] = {}
        self.add(objects)

    def add(self, objects: Iterable[Object]) -> None:
        """Have these objects, too, with their defaults as values; without the optional ones."""
        new = {(entry.index, entry.sub): entry for entry in objects if not entry.optional}
        self._objects |= new
        self._indexes = {index for index, _ in self._objects}
        self._ranges = {entry.name: _range(entry) for entry in self._objects.values()}
        self._values |= _defaults(new.values())

    @property
    def numbers(self) -> list[Object]:
        """All objects that hold a number."""
        return [entry for entry in self._objects.values() if entry.name in self._values]

    def reset(self) -> None:
        """Reset all values to their defaults."""
        self._values = _defaults(self._objects.values())

    def find(self, index: int, sub: int) -> Object:
        """The object at an address; raises `Abort`."""
        if index not in self._indexes:
            raise Abort(AbortCode.NO_OBJECT)
        if (index, sub) not in self._objects:
            raise Abort(AbortCode.NO_SUBINDEX)
        return self._objects[index, sub]

    def get(self, name: str) -> int:
        """The value of a number."""
        return self._values[name]

    def rate(self, name: str) -> float:
        """A speed in counts/s, or an acceleration in counts/s^2."""
        return self._values[name] * self.unit(name)

    def unit(self, name: str) -> float:
        """What one of a speed or an acceleration is, in counts/s or counts/s^2; 1 without objects 60A9h and 60AAh."""
        unit = self._values.get("si_acceleration" if "celeration" in name else "si_velocity")
        return 1.0 if unit is None else unit_in_counts(unit, self._counts_per_rev)

    def set(self, name: str, value: int) -> None:
        """Change the value of a number, whatever its access; a value out of range becomes the nearest in range."""
        low, high = self._ranges[name]
        self._values[name] = value if low <= value <= high else min(high, max(low, value))

    def read(self, entry: Object) -> bytes:
        """The bytes of an object; raises `Abort` if it cannot be read."""
        if entry.access == "wo":
            raise Abort(AbortCode.WRITE_ONLY)
        return entry.default if isinstance(entry.default, bytes) else entry.encode(self._values[entry.name])

    def check(self, entry: Object, data: bytes) -> int:
        """The value that a client writes; raises `Abort` if the write is not allowed."""
        if entry.access == "ro":
            raise Abort(AbortCode.READ_ONLY)
        if len(data) != entry.size:
            raise Abort(AbortCode.TOO_LONG if len(data) > entry.size else AbortCode.TOO_SHORT)
        value = entry.decode(data)
        if (entry.low is not None and value < entry.low) or (entry.high is not None and value > entry.high):
            raise Abort(AbortCode.VALUE)
        return value


def _defaults(objects: Iterable[Object]) -> dict[str, int]:
    return {entry.name: entry.default for entry in objects if isinstance(entry.default, int)}


def _range(entry: Object) -> tuple[int, int]:
    bits = 8 * entry.size
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if entry.signed else (0, (1 << bits) - 1)
