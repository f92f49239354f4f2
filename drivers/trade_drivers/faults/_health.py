"""Publishes the health of a robot's providers in the registry."""

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
    """A thread that publishes the health of providers, since bus threads may not wait for that.

    Args:
        watched: each provider with the functions that judge its health; the first result that is not healthy counts.
        tell: publishes the health of a provider.
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
        self._published: dict[object, str] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread. Idempotent."""
        self._closing.set()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while not self._closing.wait(_LOOK_EVERY_S):
            self._look()

    def _look(self) -> None:
        for provider, knowing in self._watched.items():
            health = next((text for know in knowing if (text := know()) != HEALTHY), HEALTHY)
            if health != self._published.get(provider, HEALTHY):
                self._published[provider] = health
                with suppress(TradeError):  # the container has ended, or the provider was withdrawn
                    self._tell(provider, health)
