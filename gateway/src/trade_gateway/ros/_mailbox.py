"""Callbacks on threads of their own: one after another (`Mailbox`), or each at once (`AtOnce`), for stops."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

__all__ = ["AtOnce", "Mailbox"]

_T = TypeVar("_T")
_END_S: Final = 2.0
"""How long closing waits for what is being told; it may go on after that."""

_log: Final = logging.getLogger("trade")


class Mailbox(Generic[_T]):
    """Nobody who puts something in waits; the oldest goes if it is full, and what waited too long is not told."""

    def __init__(
        self,
        name: str,
        tell: Callable[[_T], object],
        *,
        most: int | None = None,
        longest_s: float = float("inf"),
        drop: Callable[[_T], object] | None = None,
        end_s: float = _END_S,
    ) -> None:
        """Args:
        name: of the thread.
        tell: called with each; what it raises is logged.
        most: how many wait at most; None: any number.
        longest_s: how long one waits at most, in seconds.
        drop: called with each that is not told after all.
        end_s: how long closing waits for what is being told, in seconds.
        """
        self._tell = tell
        self._most = most
        self._end_s = end_s
        self._longest_s = longest_s
        self._drop = drop
        self._waiting: deque[tuple[float, _T]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: _T) -> None:
        """Have it told; after the end it is dropped."""
        dropped: list[_T] = []
        with self._changed:
            if self._closed:
                dropped.append(item)
            else:
                self._waiting.append((time.monotonic(), item))
                if self._most is not None and len(self._waiting) > self._most:
                    dropped.append(self._waiting.popleft()[1])
                self._changed.notify()
        self._leave(dropped)

    def close(self) -> None:
        """Tell no more. Idempotent; may be called by who is told."""
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
    """Nobody who puts something in waits, and nothing waits for another; never too late to be told.

    Only when all threads there may be are busy one waits, for the first that is free.
    """

    def __init__(self, name: str, tell: Callable[[_T], object], *, most: int, drop: Callable[[_T], object]) -> None:
        """Args:
        name: of the threads.
        tell: called with each; what it raises is logged.
        most: how many are told at a time.
        drop: called with each that is not told after all.
        """
        self._name = name
        self._tell = tell
        self._most = most
        self._drop = drop
        self._waiting: deque[_T] = deque()
        self._threads: set[threading.Thread] = set()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, item: _T) -> None:
        """Have it told; after the end it is dropped."""
        thread = threading.Thread(target=self._run, args=(item,), name=self._name, daemon=True)
        with self._changed:
            closed = self._closed
            at_once = not closed and len(self._threads) < self._most
            if at_once:
                self._threads.add(thread)
            elif not closed:
                self._waiting.append(item)
        if closed:
            _quietly(self._name, self._drop, item)
        elif at_once:
            self._start(thread, item)

    def close(self) -> None:
        """Tell no more. Idempotent; may be called by who is told."""
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
        except RuntimeError:  # the system has no more threads
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
    except Exception:  # noqa: BLE001 - what comes next is to be told, too
        _log.exception("%s failed", name)
