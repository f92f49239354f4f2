"""What a signal asks for, and who waits for that."""

import queue
import time

__all__ = ["SignalEvent"]


class SignalEvent:
    """Used as a `threading.Event`, which may not be set in the handler of a signal.

    A handler runs on the main thread, amid whatever that is doing. If it just waits for an event, it may have the lock
    of that event, and setting it would wait for that lock for ever: a robot that does not leave when it is told to.
    """

    def __init__(self) -> None:
        self._asked = False
        self._bell = queue.SimpleQueue[None]()

    def set(self) -> None:
        """It is asked for; from a handler, too."""
        self._asked = True
        self._bell.put(None)  # of all queues the one that a handler may put into

    def clear(self) -> None:
        """It has been done."""
        self._asked = False

    def is_set(self) -> bool:
        return self._asked

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is asked for, or for so many seconds; whether it is."""
        until = None if timeout is None else time.monotonic() + timeout
        while not self._asked:
            try:
                self._bell.get(timeout=None if until is None else max(0.0, until - time.monotonic()))
            except queue.Empty:
                break
            if self._asked:
                self._bell.put(None)  # for others who wait
        return self._asked
