"""The clock of long waits: deadlines, notifications, locks and leases. A test's system has one that the test moves."""

import threading
import time
from collections.abc import Callable


class WaitClock:
    """The computer's clocks, and the waits on a condition that last until a time of them."""

    ahead_ns: int = 0
    """How far it is ahead of the computer's monotonic clock, in nanoseconds."""

    def now(self) -> float:
        """The monotonic time, in seconds."""
        return time.monotonic()

    def now_ns(self) -> int:
        """The monotonic time, in nanoseconds."""
        return time.monotonic_ns()

    def time(self) -> float:
        """The time of the day, in seconds since the epoch."""
        return time.time()

    def wait(
        self,
        changed: threading.Condition,
        timeout_s: float | None,
        *,
        again: bool = True,  # noqa: ARG002 - for a clock that a test moves
    ) -> bool:
        """Waits on a condition whose lock is held. Returns False after the timeout.

        Args:
            changed: the condition.
            timeout_s: the longest time, in seconds; None: until it is notified.
            again: whether this thread soon waits once more, on any condition.
        """
        return changed.wait(timeout_s)

    def expect(self, what: object = None) -> None:
        """Announces what comes soon, so that a test does not move the time before it.

        Args:
            what: a condition on which a thread will wait, or something of which `arrived` will be called. None: this
                thread will wait.
        """

    def arrived(self, what: object = None) -> None:
        """Reports that something announced has come, or will not come. None: this thread waits no more."""

    def give_time(self, late: Callable[[], bool]) -> None:
        """Waits, right after a test has moved the time, while threads that had time until then are still late."""
