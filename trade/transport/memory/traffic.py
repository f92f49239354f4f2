"""The messages in flight in a network, and advancing the time for them."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Generator
from typing import Final

from trade.transport.memory.clock import Clock

_LOOK_AGAIN_S: Final = 0.001

Arrive = Callable[[], None]


class Traffic:
    """Messages that have a delay, until they arrive.

    Time advances only on request. ``settle`` is for messages that a test sent itself. ``drive`` and ``flowing`` are
    for replies of real threads: the time advances with the messages, as fast as they come, and stops without any.
    """

    def __init__(self, clock: Clock, locked: Callable[[Arrive], None]) -> None:
        self.clock: Final = clock
        self.under_way = 0
        self._locked = locked

    def later(self, due_ns: int, arrive: Arrive, *, urgent: bool) -> None:
        """Schedule the arrival of a message, under the network's lock."""

        def at_last() -> None:
            self.under_way -= 1
            arrive()

        self.under_way += 1
        self.clock.at(due_ns, lambda: self._locked(at_last), urgent=urgent)

    def settle(self) -> None:
        """Advance the time until nothing is in flight."""
        while self.under_way:
            self.clock.step()

    def drive(self, until: Callable[[], bool], limit_s: float = 10.0) -> None:
        """Advance the time from message to message until a condition holds that real threads bring about.

        Raises:
            TimeoutError: the condition does not hold after ``limit_s`` seconds of the real clock.
        """
        deadline = time.monotonic() + limit_s
        while not until():
            if time.monotonic() > deadline:
                raise TimeoutError(f"the condition that the network was driven for does not hold after {limit_s} s")
            if not (self.under_way and self.clock.step()):
                threading.Event().wait(_LOOK_AGAIN_S)

    @contextlib.contextmanager
    def flowing(self) -> Generator[None, None, None]:
        """Drive the network on its own thread, so that a test can wait for calls over delayed links."""
        done = threading.Event()
        arguments = (done.is_set, math.inf)
        thread = threading.Thread(target=self.drive, args=arguments, name="trade-memory-network", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
