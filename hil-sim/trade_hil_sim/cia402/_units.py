"""What a drive may say about its scale and units: objects 608Fh to 6092h and 60A8h to 60AAh (CiA 402-2). Pure.

A unit is a number of 32 bits: a power of ten, a numerator, a denominator (notation of CiA 303-2).
"""

from collections.abc import Mapping
from dataclasses import replace
from math import tau
from typing import Final

from ._objects import OPTIONAL, Object

MINUTE: Final = 0x47
Pair = tuple[int, int]


def unit_objects(
    *, position: int | None = None, velocity: int | None = None, acceleration: int | None = None, access: str = "ro"
) -> list[Object]:
    """Units of a drive that has these objects; with the access ``wo``, it refuses to be read."""
    return _having({"si_position": position, "si_velocity": velocity, "si_acceleration": acceleration}, access)


def factor_objects(
    *, encoder: Pair | None = None, gear_ratio: Pair | None = None, feed: Pair | None = None
) -> list[Object]:
    """The scale: increments per turns of the motor, turns of the motor per shaft, counts per turns of the shaft."""
    given = {"encoder": encoder, "gear_ratio": gear_ratio, "feed": feed}
    pairs = {name: (2, *numbers) for name, numbers in given.items() if numbers is not None}
    subs = ("count", "1", "2")
    return _having({f"{name}_{sub}": number for name in pairs for sub, number in zip(subs, pairs[name], strict=True)})


def _having(values: Mapping[str, int | None], access: str = "ro") -> list[Object]:
    here = [(entry, values[entry.name]) for entry in OPTIONAL if values.get(entry.name) is not None]
    return [replace(entry, access=access, default=value or 0, optional=False) for entry, value in here]


def unit_in_counts(unit: int, counts_per_rev: float) -> float:
    """Counts/s or counts/s^2 in one of a unit; 1 for a unit that is not one of a turning shaft."""
    prefix, turned, times = unit >> 24, unit >> 16 & 0xFF, unit >> 8 & 0xFF
    counts = {
        0x10: counts_per_rev / tau,
        0x41: counts_per_rev / 360,
        0xB4: counts_per_rev,
        0xC0: counts_per_rev / 60,
    }.get(turned, 1.0)
    return 10.0 ** (prefix - 256 if prefix > 127 else prefix) * counts / (60 if times == MINUTE else 1)
