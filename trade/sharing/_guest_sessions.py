"""Opens one session in the remote system for each local client session, so that S03 holds across systems."""

import threading
from collections.abc import Callable, Hashable
from typing import Final, Protocol

from trade._context.call_context import CallContext
from trade._context.sessions import Session, foreign, within
from trade.errors import Busy, SessionEnded

MOST: Final = 1024


class RemoteContainer(Protocol):
    """The container that acts for the clients."""

    def open_session(self, client: str, *, system: str = "") -> Session: ...


class LocalContainer(Protocol):
    """The container that the clients call."""

    def require_present(self, session: str) -> None:
        """Raises SessionEnded: the session does not exist."""
        ...


class GuestSessions:
    """Sessions in another system, which end with the local sessions that they represent."""

    def __init__(self, here: LocalContainer, there: RemoteContainer, system: str) -> None:
        self._here = here
        self._there = there
        self._system = system
        self._sessions: dict[str, Session] = {}
        self._used: dict[str, set[Hashable]] = {}
        self._lock = threading.Lock()
        self._closed = False

    def of(self, call: CallContext, what: Hashable) -> list[Session]:
        """The sessions for which a call continues there, nearest first.

        Args:
            call: the incoming call.
            what: identifies the object of the call, for `leave`.

        Raises:
            SessionEnded: one of the sessions does not exist (any more).
            Busy: too many sessions are active already.
        """
        return [self._of(session, call, what) for session in dict.fromkeys(call.sessions)]

    def _of(self, session: str, call: CallContext, what: Hashable) -> Session:
        with self._lock:
            found = self._sessions.get(session)
            full = found is None and len(self._sessions) >= MOST
        if full:
            raise Busy(service=call.service, container=f"at the border of {self._system}")
        if found is None:
            self._here.require_present(session)
            found = self._entered(session)
            try:
                self._here.require_present(session)  # it may have ended since, before this session was listed
            except SessionEnded:
                self.ended(session)
                raise
        with self._lock:
            self._used.setdefault(session, set()).add(what)
        return found

    def _entered(self, session: str) -> Session:
        made = self._there.open_session(foreign(session) or session.split("/", maxsplit=1)[0], system=self._system)
        with self._lock:
            kept = made if self._closed else self._sessions.setdefault(session, made)
        if kept is not made or self._closed:
            made.close()
        return kept

    def ended(self, session: str) -> None:
        """End the remote sessions of a session (or of one within it) that ended: motion stops, locks are released."""
        self._end(lambda name: within(name, session))

    def leave(self, what: Hashable) -> None:
        """An object was withdrawn: end the sessions that used it only; their next call opens new ones."""
        with self._lock:
            names = {name for name, used in self._used.items() if what in used}
        self._end(lambda name: name in names)

    def _end(self, meant: Callable[[str], bool]) -> None:
        with self._lock:
            gone = [self._sessions.pop(name) for name in list(self._sessions) if meant(name)]
            for name in list(self._used):
                if meant(name):
                    del self._used[name]
        for session in gone:
            session.close()

    def close(self) -> None:
        """End all sessions. Idempotent."""
        with self._lock:
            self._closed = True
        self._end(lambda _: True)
