"""What is under way in a network, and moving the time on for it."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Generator
from typing import Final

from trade._transport.memory.clock import Clock

_LOOK_AGAIN_S: Final = 0.001

Arrive = Callable[[], None]


class Traffic:
    """Messages that have a delay, until they arrive.

    Time moves only when told to. ``settle`` is for what a test sent itself; ``drive`` and ``flowing`` are for what real
    threads answer: the time goes on with the messages, as fast as they come, and stands while nothing is under way.
    """

    def __init__(self, clock: Clock, locked: Callable[[Arrive], None]) -> None:
        self.clock: Final = clock
        self.under_way = 0
        self._locked = locked

    def later(self, due_ns: int, arrive: Arrive, *, urgent: bool) -> None:
        """Let something arrive at a time, under the network's lock."""

        def at_last() -> None:
            self.under_way -= 1
            arrive()

        self.under_way += 1
        self.clock.at(due_ns, lambda: self._locked(at_last), urgent=urgent)

    def settle(self) -> None:
        """Move the time on until nothing is under way."""
        while self.under_way:
            self.clock.step()

    def drive(self, until: Callable[[], bool], limit_s: float = 10.0) -> None:
        """Move the time on from message to message until something holds that real threads bring about.

        Raises:
            TimeoutError: it does not hold after ``limit_s`` seconds of the real clock.
        """
        deadline = time.monotonic() + limit_s
        while not until():
            if time.monotonic() > deadline:
                raise TimeoutError(f"what the network was driven for does not hold after {limit_s} s")
            if not (self.under_way and self.clock.step()):
                threading.Event().wait(_LOOK_AGAIN_S)

    @contextlib.contextmanager
    def flowing(self) -> Generator[None, None, None]:
        """Drive the network from a thread of its own, so that one may wait for calls over delayed links."""
        done = threading.Event()
        arguments = (done.is_set, math.inf)
        thread = threading.Thread(target=self.drive, args=arguments, name="trade-memory-network", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
