"""The end of a container because somebody asks for it from anywhere."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from trade._resources import Resource

_logger = logging.getLogger("trade")
_ANSWERED_S: Final = 2.0
_LOOK_EVERY_S: Final = 0.01


class Terminating:
    """Brings what moves to rest at once, then closes the container as soon as whoever asked has been answered."""

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
        self.close = close
        """What ends it; a program that lives for its container puts its own end here, which closes the container."""
        self._first = threading.Lock()

    def begin(self, reason: str, who: str) -> list[str]:
        """Stop what moves, and see to it that the container closes; what could not be stopped, and why."""
        problems = self._rest(self._resources(), f"container {self._name} is terminated: {reason}")
        if self._first.acquire(blocking=False):
            _logger.warning("container %s is terminated by %s: %s", self._name, who, reason or "no reason given")
            threading.Thread(target=self._end, name="trade-terminate", daemon=True).start()
        return problems

    def _end(self) -> None:
        until = time.monotonic() + _ANSWERED_S
        while self._running() and time.monotonic() < until:
            time.sleep(_LOOK_EVERY_S)
        self.close()
