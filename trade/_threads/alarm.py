"""A thread that looks at something when it is due, or sooner when asked."""

import math
import threading
from collections.abc import Callable
from typing import Final

from trade._transport.wait_clock import WaitClock

NEVER: Final = math.inf


class Alarm:
    """Looks again and again, each time when the previous look says.

    Args:
        name: the name of its thread, which begins with `start` or the first `by`.
        look: does what is due; returns when to look again, in nanoseconds of the clock, or `NEVER`.
        clock: the clock of these times.
    """

    def __init__(self, name: str, look: Callable[[], float], clock: WaitClock) -> None:
        self._name = name
        self._look = look
        self._clock = clock
        self._changed = threading.Condition()
        self._rung = False
        """Whether to look before `next_ns`."""
        self._closed = False
        self.next_ns = NEVER
        """When it looks next. While it looks this is `NEVER`, so what becomes due sooner rings."""
        self.thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to look."""
        self.thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self.thread.start()

    def by(self, due_ns: float) -> None:
        """Look at that time at the latest. Two threads must not call this at once before it has started."""
        if self.thread is None:
            self.start()
        if due_ns < self.next_ns:
            self.ring()

    def ring(self) -> None:
        """Look at once."""
        with self._changed:
            if not self._closed:
                self._rung = True
                self._clock.expect(self._changed)
                self._changed.notify_all()

    def _run(self) -> None:
        while not self._closed:
            self._rung = False
            self.next_ns = NEVER
            self.next_ns = self._look()
            with self._changed:
                while not (self._rung or self._closed) and (left_ns := self.next_ns - self._clock.now_ns()) > 0:
                    self._clock.wait(self._changed, None if left_ns == NEVER else left_ns / 1e9)
        self._clock.arrived()

    def close(self) -> None:
        """End the thread. Idempotent."""
        with self._changed:
            self._closed = True
            self._clock.arrived(self._changed)
            self._changed.notify_all()
        if self.thread is not None and self.thread is not threading.current_thread():
            self.thread.join(2)
