"""What came and is yet to be told, one after another, on a thread of its own."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

__all__ = ["Mailbox"]

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
    ) -> None:
        """Args:
        name: of the thread.
        tell: called with each; what it raises is logged.
        most: how many wait at most; None: any number.
        longest_s: how long one waits at most, in seconds.
        drop: called with each that is not told after all.
        """
        self._tell = tell
        self._most = most
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
            self._thread.join(_END_S)

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
                self._quietly(self._tell, item)

    def _leave(self, items: list[_T]) -> None:
        if self._drop is not None:
            for item in items:
                self._quietly(self._drop, item)

    def _quietly(self, call: Callable[[_T], object], item: _T) -> None:
        try:
            call(item)
        except Exception:  # noqa: BLE001 - what comes next is to be told, too
            _log.exception("%s failed", self._thread.name)
