"""Counters of a container for monitoring: integers, incremented where calls end."""

import threading
from bisect import bisect_left
from typing import Final, Literal

from msgspec import Struct

BOUNDS_S: Final = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)
"""Upper bounds of the histogram's buckets; the last bucket has none."""
_BOUNDS_NS: Final = tuple(int(bound * 1e9) for bound in BOUNDS_S)


class Measure(Struct, frozen=True):
    """The current value of one number."""

    name: str
    """Such as ``bus_cycles``; Prometheus names it ``trade_bus_cycles_total``."""
    doc: str
    value: float
    labels: dict[str, str] = {}
    kind: Literal["counter", "gauge"] = "gauge"


class Timer:
    """The durations and failures of one service, without a lock.

    CPython 3.10 to 3.13 switches threads at calls and backward jumps only, and so not within ``+=``.
    """

    __slots__ = ("counts", "failures", "sum_ns")

    def __init__(self) -> None:
        self.counts = [0] * (len(BOUNDS_S) + 1)
        self.failures = 0
        self.sum_ns = 0

    def add(self, took_ns: int, *, failed: bool) -> None:
        """Count a call that has ended."""
        self.counts[bisect_left(_BOUNDS_NS, took_ns)] += 1
        self.sum_ns += took_ns
        if failed:
            self.failures += 1


class CallCounters:
    """The counters of a container's calls."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._timed: dict[str, Timer] = {}
        self._refusals: dict[str, int] = {}

    def of(self, label: str) -> Timer:
        """The timer of a service; services of one label share it."""
        with self._guard:
            return self._timed.setdefault(label, Timer())

    def refuse(self, reason: str) -> None:
        """Count a refused request."""
        with self._guard:
            self._refusals[reason] = self._refusals.get(reason, 0) + 1

    def timed(self) -> dict[str, Timer]:
        """The timers by service."""
        with self._guard:
            return dict(self._timed)

    def refusals(self) -> dict[str, int]:
        """The counts by the type of the error."""
        with self._guard:
            return dict(self._refusals)
