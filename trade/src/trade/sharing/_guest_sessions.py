"""The clients of one system while they are at work in another one: a session there for each session here (S03)."""

import threading
from collections.abc import Callable, Hashable
from typing import Final, Protocol

from trade._context.call_context import CallContext
from trade._context.sessions import Session, foreign, within
from trade.errors import Busy, SessionEnded

MOST: Final = 1024


class RemoteContainer(Protocol):
    """The container that acts for them."""

    def open_session(self, client: str, *, system: str = "") -> Session: ...


class LocalContainer(Protocol):
    """The container they come to."""

    def require_present(self, session: str) -> None:
        """Raises SessionEnded: nobody of it is there."""
        ...


class GuestSessions:
    """Sessions in another system, ended with those they stand for."""

    def __init__(self, here: LocalContainer, there: RemoteContainer, system: str) -> None:
        self._here = here
        self._there = there
        self._system = system
        self._sessions: dict[str, Session] = {}
        self._used: dict[str, set[Hashable]] = {}
        self._lock = threading.Lock()
        self._closed = False

    def of(self, call: CallContext, what: Hashable) -> list[Session]:
        """For whom a call that came here goes on there, nearest first.

        Args:
            call: as it came.
            what: names what it is about, for `leave`.

        Raises:
            SessionEnded: one of them is not there (any more).
            Busy: too many are at work already.
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
                self._here.require_present(session)  # it may have ended while it was let in, and we were told before
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
        """Nobody of it (or of one within it) is here any more: what it set moving there stops, its locks fall."""
        self._end(lambda name: within(name, session))

    def leave(self, what: Hashable) -> None:
        """That is withdrawn from all of them: who was about it begins anew."""
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
        """All of them end. Idempotent."""
        with self._lock:
            self._closed = True
        self._end(lambda _: True)
