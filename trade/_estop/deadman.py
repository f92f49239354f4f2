"""The deadman: stops motion whose session, lease or lock has ended."""

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

NO_CLIENT: Final = "trade/"
"""The session of stops that no client has requested."""
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
        """Stops the session's motion, and nothing else (S05)."""
        its_own = [
            one for one in self._resources() if one.busy and any(within(mover, session) for mover in one.sessions)
        ]
        if moving := [one for one in its_own if self._stop_of(one) is not None]:
            self.stop(moving, f"session {session} has ended", _unsafe)

    def rest(self, resources: Sequence[Resource], reason: str) -> list[str]:
        """Stops those of these that move, and waits for it; returns what could not be stopped, and why."""
        busy = [one for one in resources if one.busy and self._stop_of(one) is not None]
        problems, stops = list[str](), threading.Semaphore(0)

        def on_stopped(resource: Resource, problem: str) -> None:
            if problem:
                problems.append(f"{resource.name}: {problem}")
            stops.release()

        self.stop(busy, reason, on_stopped)
        for _ in busy:
            stops.acquire(timeout=2 * _STOP_S)
        return problems

    def stop(self, resources: Sequence[Resource], reason: str, on_stopped: Callable[[Resource, str], None]) -> None:
        """Makes permits for these void, asks their calls to end, and stops them; does not wait.

        Args:
            resources: what to stop.
            reason: why, for logs.
            done: called for each resource when its stop is over, with the problem, or an empty text.
        """
        by_stop: dict[LocalService, list[Resource]] = {}
        for resource in resources:
            resource.stop("trade", (), reason)
            service = self._stop_of(resource)
            if service is None:  # nothing physical: its calls are asked to end
                on_stopped(resource, "")
            else:
                by_stop.setdefault(service, []).append(resource)
        _ask_to_end(resources)
        for service, stopped in by_stop.items():
            names = [resource.name for resource in stopped]
            self._audit.note("stop", service.label, about=names, why=reason)
            _logger.warning("stopping %s: %s", ", ".join(names), reason)
            self._begin(service, _each(stopped, on_stopped))

    def everything(self, on_stopped: Callable[[list[str]], None]) -> None:
        """Asks all calls to end and calls every stop service, a shared one once; does not wait.

        A resource that could not be stopped is unsafe from then on (S14).

        Args:
            done: called when all stops are over, with the problems.
        """
        resources = self._resources()
        stops: dict[LocalService, list[Resource]] = {service: [] for service in self._stops() if not service.resources}
        _ask_to_end(resources)
        for resource in resources:
            service = self._stop_of(resource)
            if service is not None:
                stops.setdefault(service, []).append(resource)
        stop_group = _StopGroup(stops, on_stopped)
        for service in stops:
            self._begin(service, stop_group.ended_by(service))

    def _begin(self, service: LocalService, ended: Callable[[str], None]) -> None:
        threading.Thread(target=self._stop, args=(service, ended), name="trade-deadman", daemon=True).start()

    def _stop(self, service: LocalService, ended: Callable[[str], None]) -> None:
        first = threading.Lock()

        def end(problem: str) -> None:
            if first.acquire(blocking=False):  # a result after the time-out does not count
                ended(problem)

        timer = threading.Timer(_STOP_S, end, (f"{service.label} did not end within {_STOP_S:g} s",))
        timer.daemon = True
        timer.start()
        try:
            service.run_admitted((), {}, CallContext(0, service.label, "trade", NO_CLIENT, None))
            problem = ""
        except Exception as error:  # noqa: BLE001 - after any error the resource is not safe to grant again
            problem = f"{service.label} failed: {error}"
        timer.cancel()
        end(problem)


class _StopGroup:
    """Stops that began together, until the last one is over."""

    def __init__(
        self, stops: Mapping[LocalService, Sequence[Resource]], on_stopped: Callable[[list[str]], None]
    ) -> None:
        self._stops = stops
        self._on_stopped = on_stopped
        self._unfinished = set(stops)
        self._problems: list[str] = []
        self._guard = threading.Lock()
        if not stops:
            on_stopped([])

    def ended_by(self, service: LocalService) -> Callable[[str], None]:
        return lambda problem: self._service_stopped(service, problem)

    def _service_stopped(self, service: LocalService, problem: str) -> None:
        """Takes the first result of each service; later ones do not count."""
        with self._guard:
            if service not in self._unfinished:
                return
            self._unfinished.remove(service)
            if problem:
                self._problems.append(problem)
            last = not self._unfinished
        for resource in self._stops[service] if problem else ():
            resource.stop_ended(problem)
        if last:
            self._on_stopped(self._problems)


def _each(resources: Sequence[Resource], on_stopped: Callable[[Resource, str], None]) -> Callable[[str], None]:
    def ended(problem: str) -> None:
        for resource in resources:
            on_stopped(resource, problem)

    return ended


def _ask_to_end(resources: Sequence[Resource]) -> None:
    """Asks the running calls of these to end."""
    end_calls([one.cancel for resource in resources for one in list(resource.calls.values()) if one.cancel])


def _unsafe(resource: Resource, problem: str) -> None:
    """Marks a resource that could not be stopped: no client can lock it before it is resumed (S14)."""
    resource.stop_ended(problem)
    if problem:
        _logger.error("%s could not be stopped: %s", resource.name, problem)
