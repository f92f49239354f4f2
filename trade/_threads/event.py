"""An event that callbacks subscribe to: a room emits it for the rooms above."""

from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Event(Generic[T]):
    """Calls its subscribers in the order of subscription, on the thread that emits."""

    def __init__(self) -> None:
        self._subscribers: list[Callable[[T], object]] = []

    def subscribe(self, callback: Callable[[T], object]) -> Callable[[], None]:
        """Calls this at each event from now on; it must not wait. Returns a function that unsubscribes."""
        self._subscribers.append(callback)
        return lambda: self._subscribers.remove(callback)

    def emit(self, value: T) -> None:
        """Calls all subscribers."""
        for callback in list(self._subscribers):
            callback(value)
