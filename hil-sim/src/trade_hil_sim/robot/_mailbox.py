"""What other threads ask the thread of a bus to do, which waits for its wires and for a bell."""

import os
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, TypeVar

from trade_hil_sim.faults._commands import SimulationError

__all__ = ["Mailbox"]

_T = TypeVar("_T")


class Mailbox:
    """Calls to be made in one thread, in the order they came; nobody is left waiting when that ends.

    Args:
        who: whose thread it is, for messages.
        answer_s: how long one may take.
    """

    def __init__(self, who: str, answer_s: float) -> None:
        self._who, self._answer_s = who, answer_s
        self._asked: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._guard = threading.Lock()
        self._rope = -1
        """Where the bell is rung; below 0 while nobody listens."""
        self.bell = -1
        """Readable when something was asked for, or `ring` was called."""

    def open(self) -> None:
        """From here on the bell can be heard."""
        self.bell, self._rope = os.pipe()
        os.set_blocking(self.bell, False)
        os.set_blocking(self._rope, False)

    def ask(self, act: Callable[[], _T]) -> _T:
        """Have the thread make a call, and wait for what comes of it; not to be called in the thread itself.

        Raises:
            SimulationError: it does not listen any more.
            TimeoutError: it is busy with something else.
        """
        done: Future[_T] = Future()

        with self._guard:
            if self._rope < 0:
                raise self._closed()
            self._asked.append((act, done))
            self._ring()
        return done.result(self._answer_s)

    def ring(self) -> None:
        """Wake the thread, for it to look for itself."""
        with self._guard:
            self._ring()

    def run(self) -> None:
        """In the thread, when the bell is heard: do what was asked."""
        with suppress(BlockingIOError):
            os.read(self.bell, 4096)
        while self._asked:
            act, done = self._asked.popleft()
            try:
                done.set_result(act())
            except Exception as problem:  # noqa: BLE001  # handed to the thread that asked
                done.set_exception(problem)

    def close(self) -> None:
        """In the thread, at its end: who has asked and who does so from now on is told."""
        with self._guard:
            os.close(self._rope)
            self._rope = -1
        os.close(self.bell)
        while self._asked:
            self._asked.popleft()[1].set_exception(self._closed())

    def _closed(self) -> SimulationError:
        return SimulationError(f"{self._who} is closed")

    def _ring(self) -> None:
        if self._rope >= 0:
            with suppress(BlockingIOError):  # it is rung already
                os.write(self._rope, b"!")
