"""An event that callbacks subscribe to: what happens in one room, for those above it."""

from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Event(Generic[T]):
    """Calls its subscribers in the order in which they came, on the thread that emits it."""

    def __init__(self) -> None:
        self._subscribers: list[Callable[[T], object]] = []

    def subscribe(self, callback: Callable[[T], object]) -> Callable[[], None]:
        """Have this called each time from now on; it must not wait. Returns what ends that."""
        self._subscribers.append(callback)
        return lambda: self._subscribers.remove(callback)

    def emit(self, value: T) -> None:
        """Call all subscribers."""
        for callback in list(self._subscribers):
            callback(value)
