"""Stops what somebody set moving who is not there any more: the end of a session, of a lease, of a lock."""

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Final

from trade._context import CallContext
from trade._dispatch import LocalService
from trade._locks import within
from trade._resources import Resource

_logger = logging.getLogger("trade")

_STOP_S: Final = 2.0
"""How long a joint may take to come to rest (S05)."""


class Deadman:
    """Calls the stop services of this container's own resources."""

    def __init__(self, stop_of: Callable[[Resource], LocalService | None], resources: Callable[[], Sequence[Resource]]):
        self._stop_of = stop_of
        self._resources = resources

    def session_ended(self, session: str) -> None:
        """What it set moving stops, and nothing else (S05)."""
        its_own = [one for one in self._resources() if one.busy and any(within(mover, session) for mover in one.movers)]
        if its_own:
            self.stop(its_own, f"session {session} has ended", _log_failure)

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
        cancels = [one.cancel for resource in resources for one in list(resource.calls.values()) if one.cancel]
        if cancels:
            threading.Thread(target=_end_calls, args=(cancels,), name="trade-deadman", daemon=True).start()
        for service, stopped in by_stop.items():
            _logger.warning("stopping %s: %s", ", ".join(resource.name for resource in stopped), reason)
            threading.Thread(
                target=self._stop, args=(service, stopped, done), name="trade-deadman", daemon=True
            ).start()

    def _stop(self, service: LocalService, resources: list[Resource], done: Callable[[Resource, str], None]) -> None:
        first = threading.Lock()

        def tell(problem: str) -> None:
            if first.acquire(blocking=False):  # what comes after the time-out counts no more
                for resource in resources:
                    done(resource, problem)

        timer = threading.Timer(_STOP_S, tell, (f"{service.label} did not end within {_STOP_S:g} s",))
        timer.daemon = True
        timer.start()
        try:
            service.run_admitted((), {}, CallContext(0, service.label, "trade", "trade/", None))
            problem = ""
        except Exception as error:  # noqa: BLE001 - whatever it is, the resource is not safe to give on
            problem = f"{service.label} failed: {error}"
        timer.cancel()
        tell(problem)


def _end_calls(cancels: Sequence[Callable[[], None]]) -> None:
    for cancel in cancels:
        try:
            cancel()
        except Exception:
            _logger.exception("a call whose lock or session has ended failed to end")


def _log_failure(resource: Resource, problem: str) -> None:
    if problem:
        _logger.error("%s could not be stopped: %s", resource.name, problem)
