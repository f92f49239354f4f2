"""Grace periods for sessions out of sight because a bridge was lost: they count as alive, as bridges come back (S12).

A sign of life may disappear a moment before the loss of its link is visible, so the loss is checked twice. A bridge
that leaves closes its links one after the other: its neighbours lose sight of each other before they lose the bridge.
So its own sign as a bridge, which disappears first, begins a time in which it counts as lost, as does one far away.
"""

import math
import threading
from collections.abc import Callable
from typing import Final

from trade._threads.scheduler import NEVER, Scheduler

GRACE_S: Final = 1.0
_LOOK_S: Final = 0.05
_LEAVING_S: Final = 2.0
"""How long after a bridge a session may disappear because of it."""
_END_S: Final = 2.0


class GracePeriods:
    """Sessions whose sign of life disappeared, perhaps with a bridge; a session not back within a second is gone."""

    def __init__(
        self,
        gone: Callable[[str], None],
        bridge_lost: Callable[[], bool],
        timers: Scheduler,
        grace_s: float = GRACE_S,
        look_s: float = _LOOK_S,
    ) -> None:
        """Start without any session.

        Args:
            gone: called with each session that is gone for good, on a thread of the timers.
            bridge_lost: whether a bridge was lost a moment ago.
            timers: end the periods.
            grace_s: how long a session behind a bridge may be away, in seconds.
            look_s: how long after a sign of life disappears the loss of a bridge is known, in seconds.
        """
        self._gone = gone
        self._bridge_lost = bridge_lost
        self._grace_s = grace_s
        self._look_s = look_s
        self._clock = timers.clock
        self._due: dict[str, tuple[float, bool]] = {}
        """When to check a session, in seconds of the clock, and whether it is gone then."""
        self._bridge_left_s = -math.inf
        self._guard = threading.Lock()
        self._reporting = threading.Lock()
        """Held while a session's end is reported: a session that returns just then waits, and counts as a new one."""
        self._checks = timers.due(self._check)

    def begin(self, session: str) -> None:
        """Start the period of a session whose sign of life disappeared; does not wait."""
        with self._guard:
            at, _ = self._due.setdefault(session, (self._clock.now() + self._look_s, False))
        self._checks.by(at * 1e9)

    def bridge_left(self) -> None:
        """A bridge's sign of life as a bridge disappeared: what disappears next may only be out of sight."""
        self._bridge_left_s = self._clock.now()

    def end(self, session: str) -> bool:
        """A session's sign of life reappeared; returns whether its period was running.

        If its end is being reported right now, this waits until it was.
        """
        with self._reporting:
            return self._forget(session)

    def _forget(self, session: str) -> bool:
        """Forget a session; returns whether it had a period."""
        with self._guard:
            return self._due.pop(session, None) is not None

    def _check(self) -> float:
        """Reports the sessions that are gone for good; returns when to check again."""
        while (session := self._next()) is not None:
            with self._reporting:
                if self._forget(session):
                    self._gone(session)
        with self._guard:
            return min((at for at, _ in self._due.values()), default=NEVER) * 1e9

    def _next(self) -> str | None:
        """The next session to report as gone for good; None if there is none now."""
        with self._guard:
            while self._due and not self._checks.cancelled:
                first = min(self._due, key=self._due.__getitem__)
                at, last = self._due[first]
                if at > self._clock.now():
                    break
                if last or not (self._bridge_lost() or self._clock.now() < self._bridge_left_s + _LEAVING_S):
                    return first
                self._due[first] = (at + self._grace_s - self._look_s, True)
            return None

    def close(self) -> None:
        """Report no more sessions. Idempotent."""
        self._checks.cancel(_END_S)
