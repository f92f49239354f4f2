"""Grace periods for sessions out of sight because a bridge was lost: they count as alive, as bridges come back (S12).

A sign of life may disappear a moment before the loss of its link is visible, so the loss is checked twice.
"""

import threading
import time
from collections.abc import Callable
from typing import Final

GRACE_S: Final = 1.0
_LOOK_S: Final = 0.05


class GracePeriods:
    """Sessions whose sign of life disappeared, perhaps with a bridge; a session not back within a second is gone."""

    def __init__(
        self,
        gone: Callable[[str], None],
        bridge_lost: Callable[[], bool],
        grace_s: float = GRACE_S,
        look_s: float = _LOOK_S,
    ) -> None:
        """Start without any session.

        Args:
            gone: called with each session that is gone for good, on a thread of this object.
            bridge_lost: whether a bridge was lost a moment ago.
            grace_s: how long a session behind a bridge may be away, in seconds.
            look_s: how long after a sign of life disappears the loss of a bridge is known, in seconds.
        """
        self._gone = gone
        self._bridge_lost = bridge_lost
        self._grace_s = grace_s
        self._look_s = look_s
        self._due: dict[str, tuple[float, bool]] = {}
        """When to check a session, and whether it is gone then."""
        self._changed = threading.Condition()
        self._reporting = threading.Lock()
        """Held while a session's end is reported: a session that returns just then waits, and counts as a new one."""
        self._thread: threading.Thread | None = None
        self._closed = False

    def begin(self, session: str) -> None:
        """Start the period of a session whose sign of life disappeared; does not wait."""
        with self._changed:
            self._due.setdefault(session, (time.monotonic() + self._look_s, False))
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._run, name="trade-absence", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def end(self, session: str) -> bool:
        """A session's sign of life reappeared; returns whether its period was running.

        If its end is being reported right now, this waits until it was.
        """
        with self._reporting:
            return self._forget(session)

    def _forget(self, session: str) -> bool:
        """Forget a session; returns whether it had a period."""
        with self._changed:
            return self._due.pop(session, None) is not None

    def _run(self) -> None:
        while (session := self._next()) is not None:
            with self._reporting:
                if self._forget(session):
                    self._gone(session)

    def _next(self) -> str | None:
        """Waits for the next session to report as gone for good; None once this is closed."""
        with self._changed:
            while not self._closed:
                first = min(self._due, key=self._due.__getitem__, default=None)
                if first is None:
                    self._changed.wait()
                    continue
                at, last = self._due[first]
                if (left_s := at - time.monotonic()) > 0:
                    self._changed.wait(left_s)
                elif last or not self._bridge_lost():
                    return first
                else:
                    self._due[first] = (at + self._grace_s - self._look_s, True)
            return None

    def close(self) -> None:
        """Report no more sessions. Idempotent."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2)
