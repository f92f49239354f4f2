"""The load of all containers of a system, over the same second."""

import threading
from collections.abc import Sequence
from typing import Final

from trade import Container, LoadInfo, where

_BETWEEN_S: Final = 1.05
"""A container reports the load between two requests, at the start and at the end of a second."""
_COLUMNS: Final = (
    *("CONTAINER", "CPU %", "HOST %", "MEMORY MB", "CALLS/S", "RUNNING", "QUEUED", "THREADS", "LOAD/CORES"),
)


def loads(container: Container) -> list[LoadInfo]:
    """Returns the load of every other container; those that shut down meanwhile are missing."""
    asked = container.services(where(name="load", group="trade") & ~where.local)
    if not asked:
        return []
    container.call_all(asked)
    threading.Event().wait(_BETWEEN_S)
    return [outcome.result for outcome in container.call_all(asked) if outcome.ok]


def loads_table(found: Sequence[LoadInfo]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Returns columns and rows for people; ``-`` is a value that a system does not provide."""
    return _COLUMNS, [
        (
            info.container,
            f"{info.cpu_percent:.0f}",
            _rounded(info.host_cpu_percent),
            _rounded(None if info.memory_bytes is None else info.memory_bytes / 1e6),
            f"{info.calls_per_s:.1f}",
            str(info.in_flight),
            str(info.queued),
            str(info.threads),
            f"{_rounded(info.load_1min, 1)}/{info.cores}",
        )
        for info in found
    ]


def _rounded(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
