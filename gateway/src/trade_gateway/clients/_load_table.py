"""How busy the containers of a system are, over the same second."""

import threading
from collections.abc import Sequence
from typing import Final

from trade import Container, LoadInfo, where

_BETWEEN_S: Final = 1.05
"""A container tells of a second that it was asked at the beginning of and at the end."""
_COLUMNS: Final = (
    *("CONTAINER", "CPU %", "HOST %", "MEMORY MB", "CALLS/S", "RUNNING", "QUEUED", "THREADS", "LOAD/CORES"),
)


def loads(container: Container) -> list[LoadInfo]:
    """What every other container says; those that leave meanwhile say nothing."""
    asked = container.services(where(name="load", group="trade") & ~where.local)
    if not asked:
        return []
    container.call_all(asked)
    threading.Event().wait(_BETWEEN_S)
    return [outcome.result for outcome in container.call_all(asked) if outcome.ok]


def loads_table(found: Sequence[LoadInfo]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Columns and rows for people; ``-`` is what a system does not tell."""
    return _COLUMNS, [
        (
            info.container,
            f"{info.cpu_percent:.0f}",
            _told(info.host_cpu_percent),
            _told(None if info.memory_bytes is None else info.memory_bytes / 1e6),
            f"{info.calls_per_s:.1f}",
            str(info.in_flight),
            str(info.queued),
            str(info.threads),
            f"{_told(info.load_1min, 1)}/{info.cores}",
        )
        for info in found
    ]


def _told(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
