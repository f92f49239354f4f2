"""Stops what somebody set moving who is not there any more: the end of a session, of a lease, of a lock."""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from trade._audit.events import Audit
from trade._context.active_calls import end_calls
from trade._context.call_context import CallContext
from trade._context.sessions import within
from trade._resources.resource import Resource
from trade._services.local_service import LocalService

_logger = logging.getLogger("trade")

NOBODYS: Final = "trade/"
"""The session of stops that no client asked for."""
_STOP_S: Final = 2.0
"""How long a joint may take to come to rest (S05)."""


class Deadman:
    """Calls the stop services of this container's own resources."""

    def __init__(
        self,
        stop_of: Callable[[Resource], LocalService | None],
        stops: Callable[[], Sequence[LocalService]],
        resources: Callable[[], Sequence[Resource]],
        audit: Audit,
    ) -> None:
        self._audit = audit
        self._stop_of = stop_of
        self._stops = stops
        self._resources = resources

    def session_ended(self, session: str) -> None:
        """What it set moving stops, and nothing else (S05)."""
        its_own = [
            one for one in self._resources() if one.busy and any(within(mover, session) for mover in one.sessions)
        ]
        if moving := [one for one in its_own if self._stop_of(one) is not None]:
            self.stop(moving, f"session {session} has ended", _unsafe)

    def rest(self, resources: Sequence[Resource], reason: str) -> list[str]:
        """Stop those of these that move, and wait until that is over; what could not be stopped, and why."""
        busy = [one for one in resources if one.busy and self._stop_of(one) is not None]
        problems, over = list[str](), threading.Semaphore(0)

        def done(resource: Resource, problem: str) -> None:
            if problem:
                problems.append(f"{resource.name}: {problem}")
            over.release()

        self.stop(busy, reason, done)
        for _ in busy:
            over.acquire(timeout=2 * _STOP_S)
        return problems

    def stop(self, resources: Sequence[Resource], reason: str, done: Callable[[Resource, str], None]) -> None:
        """Void what was admitted for these, ask what runs to end, and have them stop; does not wait.

        Args:
            resources: what to stop.
            reason: why, for logs.
            done: told of each resource when it is over, with a text that says what is wrong, or an empty one.
        """
        by_stop: dict[LocalService, list[Resource]] = {}
        for resource in resources:
            resource.stop("trade", (), reason)
            service = self._stop_of(resource)
            if service is None:  # nothing physical: its calls are told to end
                done(resource, "")
            else:
                by_stop.setdefault(service, []).append(resource)
        _ask_to_end(resources)
        for service, stopped in by_stop.items():
            names = [resource.name for resource in stopped]
            self._audit.note("stop", service.label, about=names, why=reason)
            _logger.warning("stopping %s: %s", ", ".join(names), reason)
            self._begin(service, _each(stopped, done))

    def everything(self, done: Callable[[list[str]], None]) -> None:
        """Ask all that runs here to end, and call every stop there is, once for what several share; does not wait.

        What could not be stopped is unsafe from then on (S14).

        Args:
            done: told when all is over, with what is wrong.
        """
        resources = self._resources()
        stops: dict[LocalService, list[Resource]] = {service: [] for service in self._stops() if not service.resources}
        _ask_to_end(resources)
        for resource in resources:
            service = self._stop_of(resource)
            if service is not None:
                stops.setdefault(service, []).append(resource)
        together = _StopGroup(stops, done)
        for service in stops:
            self._begin(service, together.told_by(service))

    def _begin(self, service: LocalService, tell: Callable[[str], None]) -> None:
        threading.Thread(target=self._stop, args=(service, tell), name="trade-deadman", daemon=True).start()

    def _stop(self, service: LocalService, told: Callable[[str], None]) -> None:
        first = threading.Lock()

        def tell(problem: str) -> None:
            if first.acquire(blocking=False):  # what comes after the time-out counts no more
                told(problem)

        timer = threading.Timer(_STOP_S, tell, (f"{service.label} did not end within {_STOP_S:g} s",))
        timer.daemon = True
        timer.start()
        try:
            service.run_admitted((), {}, CallContext(0, service.label, "trade", NOBODYS, None))
            problem = ""
        except Exception as error:  # noqa: BLE001 - whatever it is, the resource is not safe to give on
            problem = f"{service.label} failed: {error}"
        timer.cancel()
        tell(problem)


class _StopGroup:
    """Stops that were begun together, until the last one is over."""

    def __init__(self, stops: Mapping[LocalService, Sequence[Resource]], done: Callable[[list[str]], None]) -> None:
        self._stops = stops
        self._done = done
        self._left = set(stops)
        self._problems: list[str] = []
        self._guard = threading.Lock()
        if not stops:
            done([])

    def told_by(self, service: LocalService) -> Callable[[str], None]:
        return lambda problem: self._over(service, problem)

    def _over(self, service: LocalService, problem: str) -> None:
        """The first word of each counts: who was too late was too late."""
        with self._guard:
            if service not in self._left:
                return
            self._left.remove(service)
            if problem:
                self._problems.append(problem)
            last = not self._left
        for resource in self._stops[service] if problem else ():
            resource.stop_ended(problem)
        if last:
            self._done(self._problems)


def _each(resources: Sequence[Resource], done: Callable[[Resource, str], None]) -> Callable[[str], None]:
    def tell(problem: str) -> None:
        for resource in resources:
            done(resource, problem)

    return tell


def _ask_to_end(resources: Sequence[Resource]) -> None:
    """What runs on these is to end."""
    end_calls([one.cancel for resource in resources for one in list(resource.calls.values()) if one.cancel])


def _unsafe(resource: Resource, problem: str) -> None:
    """What could not be stopped is locked by nobody before somebody resumes it (S14)."""
    resource.stop_ended(problem)
    if problem:
        _logger.error("%s could not be stopped: %s", resource.name, problem)
