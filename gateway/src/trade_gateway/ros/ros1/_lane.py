"""Callbacks in order, each kind on a thread of its own."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

__all__ = ["Lane"]

_log: Final = logging.getLogger("trade.ros1")


class Lane:
    """A thread that does what is given to it, one after the other. Nobody who gives it something waits."""

    def __init__(self, name: str, most: int = 0) -> None:
        """Args:
        name: of the thread.
        most: jobs that wait, the newest; 0: any number.
        """
        self._ready = threading.Condition()
        self._jobs: deque[Callable[[], object]] = deque(maxlen=most or None)
        self._closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    @property
    def full(self) -> bool:
        """Whether another job would take the oldest one's place."""
        return self._jobs.maxlen is not None and len(self._jobs) >= self._jobs.maxlen

    def put(self, job: Callable[[], object]) -> None:
        """Have it done; what it raises is logged."""
        with self._ready:
            if not self._closed:
                self._jobs.append(job)
                self._ready.notify()

    def close(self) -> None:
        """Begin nothing more; what is being done is not waited for. Idempotent."""
        with self._ready:
            self._closed = True
            self._jobs.clear()
            self._ready.notify()

    def _run(self) -> None:
        while (job := self._next()) is not None:
            try:
                job()
            except Exception:  # noqa: BLE001 - it is somebody else's
                _log.exception("a callback of ROS 1 failed")

    def _next(self) -> Callable[[], object] | None:
        with self._ready:
            self._ready.wait_for(lambda: self._jobs or self._closed)
            return None if self._closed else self._jobs.popleft()
