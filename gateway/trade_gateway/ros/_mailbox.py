"""Queues whose callbacks run on their own threads: in turn (`Mailbox`), or all at once (`AtOnce`), for stops."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

_T = TypeVar("_T")
_END_S: Final = 2.0
"""How long closing waits for running callbacks; they may last longer."""

_log: Final = logging.getLogger("trade")


class Mailbox(Generic[_T]):
    """A queue whose `put` never waits. When full, it drops the oldest item; items that waited too long expire."""

    def __init__(
        self,
        name: str,
        callback: Callable[[_T], object],
        *,
        most: int | None = None,
        longest_s: float = float("inf"),
        drop: Callable[[_T], object] | None = None,
        end_s: float = _END_S,
    ) -> None:
        """Args:
        name: of the thread.
        callback: called with each item; its exceptions are logged.
        most: how many items wait at most; None: any number.
        longest_s: how long an item waits at most, in seconds.
        drop: called with each dropped item.
        end_s: how long closing waits for running callbacks, in seconds.
        """
        self._tell = callback
        self._capacity = most
        self._end_s = end_s
        self._longest_s = longest_s
        self._drop = drop
        self._waiting: deque[tuple[float, _T]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: _T) -> None:
        """Queues an item; after the end it is dropped."""
        dropped: list[_T] = []
        with self._changed:
            if self._closed:
                dropped.append(item)
            else:
                self._waiting.append((time.monotonic(), item))
                if self._capacity is not None and len(self._waiting) > self._capacity:
                    dropped.append(self._waiting.popleft()[1])
                self._changed.notify()
        self._leave(dropped)

    def close(self) -> None:
        """Ends the queue. Idempotent; a callback may call it."""
        with self._changed:
            self._closed = True
            left = [item for _, item in self._waiting]
            self._waiting.clear()
            self._changed.notify()
        self._leave(left)
        if threading.current_thread() is not self._thread:
            self._thread.join(self._end_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                came_at, item = self._waiting.popleft()
            if time.monotonic() - came_at > self._longest_s:
                self._leave([item])
            else:
                _quietly(self._thread.name, self._tell, item)

    def _leave(self, items: list[_T]) -> None:
        if self._drop is not None:
            for item in items:
                _quietly(self._thread.name, self._drop, item)


class AtOnce(Generic[_T]):
    """A pool whose `put` never waits and whose items do not wait for one another, nor expire.

    An item waits only when all threads are busy, for the first that is free.
    """

    def __init__(self, name: str, callback: Callable[[_T], object], *, most: int, drop: Callable[[_T], object]) -> None:
        """Args:
        name: of the threads.
        callback: called with each item; its exceptions are logged.
        most: how many callbacks run at a time.
        drop: called with each dropped item.
        """
        self._name = name
        self._tell = callback
        self._limit = most
        self._drop = drop
        self._waiting: deque[_T] = deque()
        self._threads: set[threading.Thread] = set()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, item: _T) -> None:
        """Runs the callback for an item; after the end the item is dropped."""
        thread = threading.Thread(target=self._run, args=(item,), name=self._name, daemon=True)
        with self._changed:
            closed = self._closed
            at_once = not closed and len(self._threads) < self._limit
            if at_once:
                self._threads.add(thread)
            elif not closed:
                self._waiting.append(item)
        if closed:
            _quietly(self._name, self._drop, item)
        elif at_once:
            self._start(thread, item)

    def close(self) -> None:
        """Ends the pool. Idempotent; a callback may call it."""
        with self._changed:
            self._closed = True
            left = list(self._waiting)
            self._waiting.clear()
        for item in left:
            _quietly(self._name, self._drop, item)
        deadline = time.monotonic() + _END_S
        with self._changed:
            if threading.current_thread() not in self._threads:
                self._changed.wait_for(lambda: not self._threads, max(0.0, deadline - time.monotonic()))

    def _start(self, thread: threading.Thread, item: _T) -> None:
        try:
            thread.start()
        except RuntimeError:  # the thread limit is reached
            _log.exception("%s has no thread", self._name)
            with self._changed:
                self._threads.discard(thread)
            _quietly(self._name, self._drop, item)

    def _run(self, item: _T) -> None:
        while True:
            _quietly(self._name, self._tell, item)
            with self._changed:
                if not self._waiting:
                    self._threads.discard(threading.current_thread())
                    self._changed.notify_all()
                    return
                item = self._waiting.popleft()


def _quietly(name: str, call: Callable[[_T], object], item: _T) -> None:
    try:
        call(item)
    except Exception:  # noqa: BLE001 - the callbacks of later items must still run
        _log.exception("%s failed", name)
