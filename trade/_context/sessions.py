"""Sessions: a client of a program that acts for many. Its motion belongs to it and stops when it ends (S03)."""

import contextlib
from collections.abc import Callable, Generator, Iterable
from contextvars import ContextVar
from typing import Final

from trade.errors import SessionEnded
from trade.protocol.keys import Address
from trade.transport.base import Presence

_REMEMBERED: Final = 4096


def within(session: str, whole: str) -> bool:
    """Whether a session is that session or a part of it."""
    return session == whole or session.startswith(f"{whole}/")


class EndedSessions:
    """The sessions that ended last, with the reasons."""

    def __init__(self) -> None:
        self._reasons: dict[str, str] = {}

    def ended(self, session: str, reason: str) -> None:
        """Records that a session has ended."""
        self._reasons[session] = reason
        if len(self._reasons) > _REMEMBERED:
            del self._reasons[next(iter(self._reasons))]

    def back(self, session: str) -> None:
        """Records that an unreachable session is back."""
        self._reasons.pop(session, None)

    def session_error(self, sessions: Iterable[str]) -> SessionEnded | None:
        """The error of the first of these that has ended, or whose container has; None if all exist."""
        if self._reasons:
            for session in sessions:
                whole = "/".join(session.split("/")[:3])
                if (reason := self._reasons.get(session) or self._reasons.get(whole)) is not None:
                    return SessionEnded(session=session, reason=reason)
        return None


speaking: ContextVar["Session | None"] = ContextVar("trade_session", default=None)
"""The session of calls made now; None: the container's own."""


def foreign(session: str) -> str:
    """``clinic/anna via door``, if the session belongs to a client of another system; else empty.

    The identity ``door`` states this and is responsible for it: this system cannot verify the client.
    """
    identity, *chunks = session.split("/")
    system, crossed, client = chunks[2].partition(":") if len(chunks) == 3 else ("", "", "")
    return f"{system}/{client.rpartition('.')[0]} via {identity}" if crossed else ""


class Session:
    """A client's session within a container's own: a context manager; calls made inside are the client's.

    Locks taken inside are the client's, too. When it is closed, or the container ends, its motion stops and its locks
    are lost, but those of no other session. `Container.open_session` opens it.
    """

    def __init__(self, owner: Address, name: str, presence: Presence, ended: Callable[[str], None]) -> None:
        self.owner: Final = owner
        """The container that acts for the client."""
        self.name: Final = name
        """Its name in the whole system: ``identity/container/epoch/client``."""
        self._presence = presence
        self._ended = ended
        self._closed = False

    @property
    def closed(self) -> bool:
        """Whether it has ended."""
        return self._closed

    def check(self) -> None:
        """Raises SessionEnded if it has."""
        if self._closed:
            raise SessionEnded(session=self.name, reason="it was closed")

    @contextlib.contextmanager
    def use(self) -> Generator["Session", None, None]:
        """Makes the calls inside in this session, in any thread or task; does not close it."""
        reset = speaking.set(self)
        try:
            yield self
        finally:
            speaking.reset(reset)

    def close(self) -> None:
        """Ends the session: its motion stops. Does not wait for that. Idempotent."""
        if not self._closed:
            self._closed = True
            self._presence.close()
            self._ended(self.name)

    def __enter__(self) -> "Session":
        self._using = self.use()
        return self._using.__enter__()

    def __exit__(self, *error: object) -> None:
        self._using.__exit__(None, None, None)
        self.close()

    def __repr__(self) -> str:
        return f"<Session {self.name}{', ended' if self._closed else ''}>"
