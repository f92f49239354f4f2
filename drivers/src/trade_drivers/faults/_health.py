"""How the providers of a robot are, as the registry says it, whoever knows of it."""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Final

from trade._protocol.messages import HEALTHY
from trade.errors import TradeError

__all__ = ["HEALTHY", "HealthTeller"]

_LOOK_EVERY_S: Final = 0.5
_END_S: Final = 5.0


class HealthTeller:
    """A thread that says in the registry how providers are: never a bus's own, which has no time.

    Args:
        watched: each provider with those who know: what they say first counts, unless it is that it is healthy.
        tell: says of a provider how it is.
        name: of the thread.
    """

    def __init__(
        self,
        watched: Mapping[object, Sequence[Callable[[], str]]],
        tell: Callable[[object, str], object],
        name: str,
    ) -> None:
        self._watched = watched
        self._tell = tell
        self._told: dict[object, str] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it; more than once is fine."""
        self._closing.set()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while not self._closing.wait(_LOOK_EVERY_S):
            self._look()

    def _look(self) -> None:
        for provider, knowing in self._watched.items():
            health = next((text for know in knowing if (text := know()) != HEALTHY), HEALTHY)
            if health != self._told.get(provider, HEALTHY):
                self._told[provider] = health
                with suppress(TradeError):  # its container has ended, or it was withdrawn
                    self._tell(provider, health)
