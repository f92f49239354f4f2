"""Standing requests: on this occasion, make that call. Here: ``joined``, ``left`` and ``changed``."""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any

from trade._constraints import Constraint
from trade._handle import Handle
from trade._registry import Change, Record

_logger = logging.getLogger("trade")

Callback = Callable[[Handle], Any]
"""A handle of a service, or a function of this process; it is given the handle of what came, went or changed."""


class Notification:
    """A standing request; it ends when it is cancelled or its container closes."""

    def __init__(self, occasion: str, constraint: Constraint, call: Callback) -> None:
        self.occasion = occasion
        self.constraint = constraint
        self.call = call
        self._live = True

    @property
    def active(self) -> bool:
        """Whether it can still fire."""
        return self._live

    def cancel(self) -> None:
        """End it; a call under way finishes. Idempotent."""
        self._live = False

    detach = cancel

    def __repr__(self) -> str:
        return f"<Notification {self.occasion} {self.constraint}>"


class Notifier:
    """Fires the notifications of one container, one after the other, on a thread of its own."""

    def __init__(self, handle: Callable[[Record], Handle]) -> None:
        self._handle = handle
        self._standing: list[Notification] = []
        self._queue: queue.SimpleQueue[tuple[Notification, Handle] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()

    def add(self, notification: Notification, existing: list[Record]) -> None:
        """Begin; those already there fire first."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._fire, name="trade-notify", daemon=True)
                self._thread.start()
            for record in existing:
                self._queue.put((notification, self._handle(record)))
            self._standing.append(notification)

    def changed(self, change: Change) -> None:
        """Told by the registry."""
        with self._lock:
            self._standing = [standing for standing in self._standing if standing.active]
            for notification in self._standing:
                for record in _concerned(notification, change):
                    self._queue.put((notification, self._handle(record)))

    def _fire(self) -> None:
        while (item := self._queue.get()) is not None:
            notification, handle = item
            if not notification.active:
                continue
            try:
                notification.call(handle)
            except BaseException:
                _logger.exception("the call of %r failed; it stays attached", notification)

    def close(self) -> None:
        """End the thread; what has not fired will not. Idempotent."""
        for standing in self._standing:
            standing.cancel()
        self._queue.put(None)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2)


def _concerned(notification: Notification, change: Change) -> list[Record]:
    matches = notification.constraint.matches
    if notification.occasion == "joined":
        return [record for record in change.joined if matches(record)]
    if notification.occasion == "left":
        return [record for record in change.left if matches(record)]
    altered = [(old, new) for old, new in zip(change.before, change.replaced, strict=True) if old != new]
    return [new for old, new in altered if matches(old) or matches(new)]
