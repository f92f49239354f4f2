"""Stops of a whole group at once, and their report."""

import time
from collections.abc import Iterable
from typing import Protocol

from msgspec import Struct

from trade._calls.handle import CallHost, Handle
from trade._estop.controller import is_stop
from trade._registry.constraints import where
from trade._registry.registry import Record, Registry
from trade.errors import DeadlineExceeded

_LEAST_S = 0.01


class StopReport(Struct, frozen=True):
    """The results of a group's stop services."""

    group: str
    stopped: tuple[str, ...] = ()
    """The services that ended without an error, so that their resources are at rest."""
    failed: dict[str, str] = {}
    """The services that failed, with the reason of each."""

    @property
    def complete(self) -> bool:
        """Whether there was something to stop, and all of it was stopped."""
        return bool(self.stopped) and not self.failed


class Run(Protocol):
    """A call under way, as far as it is used here."""

    def exception(self, timeout_s: float | None = None) -> BaseException | None: ...


def stops_of(registry: Registry, group: str) -> list[Record]:
    """The stop services of a group, and of all groups beneath it."""
    found = registry.select(where(group=group))
    return [record for record in found if is_stop(record)]


def stop_group(home: CallHost, records: Iterable[Record], group: str, limit_s: float) -> StopReport:
    """Calls these stop services, all at once, and waits for them.

    Args:
        group: as the report names it.
        limit_s: how long to wait, in seconds.
    """
    until = time.monotonic() + limit_s
    begun: dict[str, Run] = {}
    failed: dict[str, str] = {}
    for record in records:
        try:
            begun[record.label] = Handle(home, record.key, record).start()
        except Exception as error:  # noqa: BLE001 - after any error, the others still have to stop
            failed[record.label] = _said(error)
    stopped: list[str] = []
    for label, run in begun.items():
        try:
            error = run.exception(max(_LEAST_S, until - time.monotonic()))
        except DeadlineExceeded:
            failed[label] = f"did not end within {limit_s:g} s"
            continue
        except Exception as bad:  # noqa: BLE001 - likewise
            error = bad
        if error is None:
            stopped.append(label)
        else:
            failed[label] = _said(error)
    return StopReport(group, tuple(sorted(stopped)), failed)


def together(group: str, reports: Iterable[StopReport]) -> StopReport:
    """Merges the reports of several containers: a service that one of them stopped is stopped."""
    stopped: set[str] = set()
    failed: dict[str, str] = {}
    for report in reports:
        stopped.update(report.stopped)
        failed.update(report.failed)
    return StopReport(group, tuple(sorted(stopped)), {k: failed[k] for k in sorted(failed) if k not in stopped})


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
