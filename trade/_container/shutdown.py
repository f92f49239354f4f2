"""The shutdown of a container on request of any client."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from trade._resources.resource import Resource
from trade.errors import InUse

_logger = logging.getLogger("trade")
_ANSWERED_S: Final = 2.0
_LOOK_EVERY_S: Final = 0.01


class Shutdown:
    """Stops all motion at once, then closes the container when the client has its answer."""

    def __init__(
        self,
        name: str,
        rest: Callable[[Sequence[Resource], str], list[str]],
        resources: Callable[[], Sequence[Resource]],
        running: Callable[[], int],
        close: Callable[[], None],
    ) -> None:
        self._name = name
        self._rest = rest
        self._resources = resources
        self._running = running
        self._close = close
        self._first = threading.Lock()

    def begin(self, reason: str, identity: str, *, only_at_rest: bool = False) -> list[str]:
        """Stops all motion, and closes the container afterwards; returns what could not be stopped, and why.

        Raises:
            InUse: a resource is locked or moves, with ``only_at_rest``; nothing was done.
        """
        if only_at_rest and (uses := _uses(self._resources())):
            raise InUse(container=self._name, uses=uses)
        problems = self._rest(self._resources(), f"container {self._name} is terminated: {reason}")
        if self._first.acquire(blocking=False):
            _logger.warning("container %s is terminated by %s: %s", self._name, identity, reason or "no reason given")
            threading.Thread(target=self._end, name="trade-terminate", daemon=True).start()
        return problems

    def _end(self) -> None:
        until = time.monotonic() + _ANSWERED_S
        while self._running() and time.monotonic() < until:
            time.sleep(_LOOK_EVERY_S)
        self._close()


def _uses(resources: Sequence[Resource]) -> list[str]:
    """The resources in use, as text."""
    uses: list[str] = []
    for resource in resources:
        holder = resource.pending or resource.holder
        if resource.guarded and holder is not None:
            aim = f" for {holder.purpose!r}" if holder.purpose else ""
            uses.append(f"{resource.name} is locked by {holder.owner}{aim}")
        elif resource.busy:
            uses.append(f"{resource.name} moves")
    return uses
