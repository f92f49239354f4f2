"""What a container counts for those who watch it from outside: integers, added up where calls end."""

import threading
from bisect import bisect_left
from typing import Final, Literal

from msgspec import Struct

__all__ = ["Measure"]

BOUNDS_S: Final = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)
"""Upper bounds of the classes that durations are counted in; the last class has none."""
_BOUNDS_NS: Final = tuple(int(bound * 1e9) for bound in BOUNDS_S)


class Measure(Struct, frozen=True):
    """One number as it is now."""

    name: str
    """Such as ``bus_cycles``; those who read it see ``trade_bus_cycles_total``."""
    doc: str
    value: float
    labels: dict[str, str] = {}
    kind: Literal["counter", "gauge"] = "gauge"


class Timer:
    """How long calls of one service took, and how many failed. A list's item is counted up in one step of Python's."""

    __slots__ = ("counts", "failures", "sum_ns")

    def __init__(self) -> None:
        self.counts = [0] * (len(BOUNDS_S) + 1)
        self.failures = 0
        self.sum_ns = 0

    def add(self, took_ns: int, *, failed: bool) -> None:
        """A call has ended."""
        self.counts[bisect_left(_BOUNDS_NS, took_ns)] += 1
        self.sum_ns += took_ns
        if failed:
            self.failures += 1


class CallCounters:
    """What is counted of the calls of a container."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._timed: dict[str, Timer] = {}
        self._refusals: dict[str, int] = {}

    def of(self, label: str) -> Timer:
        """Where calls of a service are counted; services of one label are counted together."""
        with self._guard:
            return self._timed.setdefault(label, Timer())

    def refuse(self, reason: str) -> None:
        """Somebody was refused something."""
        with self._guard:
            self._refusals[reason] = self._refusals.get(reason, 0) + 1

    def timed(self) -> dict[str, Timer]:
        """By service."""
        with self._guard:
            return dict(self._timed)

    def refusals(self) -> dict[str, int]:
        """By the type of the error."""
        with self._guard:
            return dict(self._refusals)
