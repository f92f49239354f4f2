"""Stops of a whole group at once, over own links and through other containers, and their report."""

import logging
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, Final

from msgspec import Struct, structs

from trade._calls.client import CallClient
from trade._calls.run import Run
from trade._context.call_context import served_call
from trade._context.sessions import Session
from trade._estop.controller import LIMIT_S, is_stop
from trade._registry.constraints import where
from trade._registry.registry import Record, Registry
from trade._services.decorator import service
from trade._threads.condition import InterruptibleCondition
from trade.protocol.keys import DOMAIN, Address, client_name
from trade.transport.base import Presence

_logger = logging.getLogger("trade")

STOP_GROUP: Final = "stop_group"
_RETRY_S: Final = 0.5
"""After this time, others are also asked to stop what has not confirmed here."""
_POLL_S: Final = 0.1
_LONGEST_REASON: Final = 500
_UNSEEN: Final = "it may see more of the group"


class StopReport(Struct, frozen=True):
    """The results of a group's stop services."""

    group: str
    stopped: tuple[str, ...] = ()
    """The services that ended without an error, so that their resources are at rest."""
    failed: dict[str, str] = {}
    """The services that failed, and the containers that did not answer, with the reason of each."""

    @property
    def complete(self) -> bool:
        """Whether there was something to stop, and all of it was stopped."""
        return bool(self.stopped) and not self.failed


def stops_of(registry: Registry, group: str) -> list[Record]:
    """The stop services of a group, and of all groups beneath it."""
    found = registry.select(where(group=group))
    return [record for record in found if is_stop(record)]


class GroupStop:
    """A stop of a group under way: the calls of its stop services, and requests to containers that may see more of it.

    Each container is asked at once for what is not known here, and a little later for what has not confirmed here.

    Args:
        client: makes the calls.
        group: what to stop, with all groups beneath it.
        reason: why, for the record of other containers; None: they are not asked.
        known: the keys of services that the caller stops itself.
    """

    def __init__(self, client: CallClient, group: str, reason: str | None, known: Iterable[str] = ()) -> None:
        self._client = client
        self._registry = client.registry
        self._group = group
        self._reason = reason
        self._known = frozenset(known)
        self._calls: dict[str, tuple[Record, Run[Any] | str]] = {}
        """By key: a service that it calls, and the call, or why that could not begin."""
        self._requests: dict[tuple[Address, bool], Run[Any] | str] = {}
        """By container, and whether it was asked for what has not confirmed here, too."""
        self._changed = InterruptibleCondition()
        self._retry_at = time.monotonic() + _RETRY_S

    def wait(self, until: float, ready: Callable[[], bool]) -> StopReport:
        """Stops what is found until then, and returns the report.

        Args:
            until: by ``time.monotonic()``.
            ready: whether to end earlier, once all calls have ended.
        """
        self._begin()
        while not (self._ended() and ready()) and (left_s := until - time.monotonic()) > 0:
            self._changed.wait_for(self._ended, min(_POLL_S, left_s))
            self._begin()
        return self.report()

    def _begin(self) -> None:
        """Begins the calls to services and containers that are new since the last time."""
        for record in stops_of(self._registry, self._group):
            if (key := str(record.key)) not in self._calls and key not in self._known:
                self._calls[key] = (record, self._start(record))
        if self._reason is None:
            return
        missing = {key for key, (_, run) in self._calls.items() if _problem(run) is not None}
        again = bool(missing) and (time.monotonic() >= self._retry_at or self._all_done())
        known = [key for key in self._calls if not (again and key in missing)]
        for record in self._registry.select(where(name=STOP_GROUP, group=DOMAIN)):
            if not record.local and (record.key.address, again) not in self._requests:
                self._requests[record.key.address, again] = self._start(record, self._group, self._reason, known)

    def _start(self, record: Record, *args: object) -> "Run[Any] | str":
        try:
            run = self._client.handle_of(record).start(*args)
        except Exception as error:  # noqa: BLE001 - after any error, the others still have to stop
            return _error_text(error)
        run.add_done_callback(lambda _: self._changed.notify_all())
        return run

    def _all_done(self) -> bool:
        return all(_is_done(run) for _, run in self._calls.values())

    def _ended(self) -> bool:
        """Whether nothing is awaited: each service is stopped, on any way, or has failed, and each other one has said.

        A container whose services are stopped need not answer itself: its link may be broken.
        """
        stopped = set(self._merged().stopped)
        late = any(not _is_done(run) and record.label not in stopped for record, run in self._calls.values())
        return not late and all(_is_done(run) for _, run in self._others(stopped))

    def _others(self, stopped: Collection[str]) -> "list[tuple[str, Run[Any] | str]]":
        """The containers that were asked, but those whose services are stopped."""
        safe = {record.key.address for record, _ in self._calls.values() if record.label in stopped}
        return [(address.who, run) for (address, _), run in self._requests.items() if address not in safe]

    def _merged(self) -> StopReport:
        """The results of services so far."""
        problems = [(record.label, _problem(run)) for record, run in self._calls.values()]
        done = tuple(label for label, problem in problems if problem is None)
        own = StopReport(self._group, done, {label: reason for label, reason in problems if reason is not None})
        answered = [run for run in self._requests.values() if isinstance(run, Run) and _problem(run) is None]
        return merge_reports(self._group, [own, *(_read(self._group, run.result(0)) for run in answered)])

    def report(self) -> StopReport:
        """The results so far.

        A container that has ended is a failure only if nothing was stopped; one that is silent may see what moves.
        """
        found = self._merged()
        problems = [(container, _problem(run), _is_done(run)) for container, run in self._others(found.stopped)]
        unseen = {
            container: f"{_UNSEEN}: {reason}"
            for container, reason, is_done in problems
            if reason and not (is_done and found.stopped)
        }
        return structs.replace(found, failed=found.failed | unseen)


class _NoPresence(Presence):
    """A stop waits for no liveliness token: callees do not look for the one of its session."""

    def close(self) -> None: ...


def session_for(own: Address, client: str) -> Session:
    """The session of stops that a container makes for a client, so that they latch what the container itself moves."""
    return Session(own, f"{own}/{client_name(client)}.stop", _NoPresence(), lambda _: None)


StopFor = Callable[[str, str, float, Sequence[str]], StopReport]
"""Stops what is known of a group: who asks, the group, the limit in seconds, the keys that the caller stops itself."""


class GroupStopServices:
    """The service of every container that stops what it sees of a group, for a caller that may see less."""

    def __init__(self, stop: StopFor) -> None:
        self._stop = stop

    @service(effect="stop")
    def stop_group(self, group: str, reason: str = "", known: tuple[str, ...] = ()) -> dict[str, str]:
        """Calls the stop services of a group, without ``known`` keys. Returns the problem of each, or an empty text."""
        call = served_call()
        _logger.warning("stopping %s, asked by %s: %s", group, call.asker, reason[:_LONGEST_REASON])
        report = self._stop(call.asker, group, LIMIT_S, known)
        return dict.fromkeys(report.stopped, "") | report.failed


def _read(group: str, problems: dict[str, str]) -> StopReport:
    """The answer of `stop_group`."""
    done = tuple(label for label, problem in problems.items() if not problem)
    return StopReport(group, done, {label: problem for label, problem in problems.items() if problem})


def _is_done(run: "Run[Any] | str") -> bool:
    return isinstance(run, str) or run.done()


def _problem(run: "Run[Any] | str") -> str | None:
    """Why a call has not succeeded; None: it has."""
    if isinstance(run, str):
        return run
    if not run.done():
        return "no answer in time"
    error = run.exception(0)
    return None if error is None else _error_text(error)


def merge_reports(group: str, reports: Iterable[StopReport]) -> StopReport:
    """Merges the reports of several containers: a service that one of them stopped is stopped."""
    stopped: set[str] = set()
    failed: dict[str, str] = {}
    for report in reports:
        stopped.update(report.stopped)
        failed.update(report.failed)
    return StopReport(group, tuple(sorted(stopped)), {k: failed[k] for k in sorted(failed) if k not in stopped})


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
