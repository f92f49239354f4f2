"""A health check that a test can close: the bus thread waits at it before every cycle."""

import threading

from tests.support.waiting import PATIENCE_S

__all__ = ["Gate"]


class Gate:
    """A health check that can hold the bus thread up, or say no."""

    def __init__(self) -> None:
        self._open, self._reached = threading.Event(), threading.Event()
        self._open.set()
        self.says = True

    def __call__(self) -> bool:
        if not self._open.is_set():
            self._reached.set()
            self._open.wait(PATIENCE_S)
        return self.says

    def hold_up(self) -> None:
        """Returns once the bus thread waits."""
        self._reached.clear()
        self._open.clear()
        assert self._reached.wait(PATIENCE_S)

    def release(self) -> None:
        self._open.set()
