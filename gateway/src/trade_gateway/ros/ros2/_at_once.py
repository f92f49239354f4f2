"""What came and is told at once, each on a thread of its own: stops."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

__all__ = ["AtOnce"]

_T = TypeVar("_T")
_END_S: Final = 2.0
"""How long closing waits for what is being told; it may go on after that."""

_log: Final = logging.getLogger("trade")


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
            self._quietly(self._drop, item)
        elif at_once:
            self._start(thread, item)

    def close(self) -> None:
        """Tell no more. Idempotent; may be called by who is told."""
        with self._changed:
            self._closed = True
            left = list(self._waiting)
            self._waiting.clear()
        for item in left:
            self._quietly(self._drop, item)
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
            self._quietly(self._drop, item)

    def _run(self, item: _T) -> None:
        while True:
            self._quietly(self._tell, item)
            with self._changed:
                if not self._waiting:
                    self._threads.discard(threading.current_thread())
                    self._changed.notify_all()
                    return
                item = self._waiting.popleft()

    def _quietly(self, call: Callable[[_T], object], item: _T) -> None:
        try:
            call(item)
        except Exception:  # noqa: BLE001 - what comes next is to be told, too
            _log.exception("%s failed", self._name)
