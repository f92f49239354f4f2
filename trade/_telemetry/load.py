"""The load of a container: its process, its host, and the calls that others make to it."""

import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Protocol

from msgspec import Struct

_WINDOW_S: Final = 1.0
_STATUS: Final = Path("/proc/self/status")
_STAT: Final = Path("/proc/stat")


class LoadInfo(Struct, frozen=True):
    """The load of a container; None where its operating system does not report a value.

    Rates and percentages are means over the last ``over_s`` seconds.
    """

    container: str
    over_s: float
    """The measured time: at least a second, unless the container is younger."""
    cpu_percent: float
    """The processor load of its process; 100 is one core."""
    host_cpu_percent: float | None
    """The processor load of its host; 100 is all cores."""
    load_1min: float | None
    """Processes of its host that run or wait for a core, a mean of the last minute."""
    cores: int
    memory_bytes: int | None
    """The resident memory of its process."""
    calls: int
    """Calls from other containers since the start, stops and the middleware's own included."""
    calls_per_s: float
    in_flight: int
    """Those of them that have a thread now, including this query and calls answered a moment ago."""
    queued: int
    """Queued calls of serial services."""
    threads: int


def busyness(load: LoadInfo, under_way: int = 0) -> tuple[float, float]:
    """How much a container has to do: calls under way and busy cores, for each core of its host; then calls a second.

    Args:
        load: its report.
        under_way: calls that are known to be under way there; the report may be older than the last ones.
    """
    percent = load.cpu_percent if load.host_cpu_percent is None else load.host_cpu_percent * load.cores
    return (max(load.in_flight + load.queued, under_way) + percent / 100) / load.cores, load.calls_per_s


class Pool(Protocol):
    """Threads that take calls."""

    @property
    def taken(self) -> int: ...
    @property
    def working(self) -> int: ...


class _Sample(Struct, frozen=True):
    at_s: float
    process_s: float
    busy: int
    ticks: int
    """Processor ticks of the host; 0, like ``busy``, if the host does not report them."""
    calls: int


class LoadMeter:
    """Measures on request, and costs nothing otherwise."""

    def __init__(
        self,
        container: str,
        pools: Callable[[], Sequence[Pool]],
        queued: Callable[[], int],
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._container = container
        self._pools = pools
        self._queued = queued
        self._clock = clock or time.monotonic
        self._lock = threading.Lock()
        self._before = self._last = self._sample()

    def _sample(self) -> _Sample:
        busy, ticks = _host_ticks()
        return _Sample(self._clock(), time.process_time(), busy, ticks, sum(pool.taken for pool in self._pools()))

    @property
    def running(self) -> int:
        """Calls of other containers that have a thread now."""
        return sum(pool.working for pool in self._pools())

    def read(self) -> LoadInfo:
        """The current load."""
        with self._lock:
            now = self._sample()
            if now.at_s - self._last.at_s >= _WINDOW_S:
                self._before, self._last = self._last, now
            before = self._before
        over_s = max(now.at_s - before.at_s, 1e-3)
        ticks = now.ticks - before.ticks
        return LoadInfo(
            container=self._container,
            over_s=over_s,
            cpu_percent=100 * (now.process_s - before.process_s) / over_s,
            host_cpu_percent=100 * (now.busy - before.busy) / ticks if ticks > 0 else None,
            load_1min=_load_1min(),
            cores=os.cpu_count() or 1,
            memory_bytes=resident_bytes(),
            calls=now.calls,
            calls_per_s=(now.calls - before.calls) / over_s,
            in_flight=self.running,
            queued=self._queued(),
            threads=threading.active_count(),
        )


def _load_1min() -> float | None:
    ask: Callable[[], tuple[float, float, float]] | None = getattr(os, "getloadavg", None)  # not on every system
    try:
        return None if ask is None else ask()[0]
    except OSError:
        return None


def resident_bytes() -> int | None:
    try:
        lines = _STATUS.read_text().splitlines()
        return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmRSS:")), None)
    except (OSError, ValueError, IndexError):
        return None


def _host_ticks() -> tuple[int, int]:
    """Ticks in which the cores of the host were busy, and all ticks."""
    try:
        with _STAT.open() as stat:
            ticks = [int(word) for word in stat.readline().split()[1:9]]  # these include the rest
    except (OSError, ValueError):
        return 0, 0
    return sum(ticks) - sum(ticks[3:5]), sum(ticks)  # without idle and I/O wait
