"""Sessions of which nobody is there any more: what comes from them late is refused."""

from collections.abc import Iterable
from typing import Final

from trade.errors import SessionEnded

_REMEMBERED: Final = 4096


def within(session: str, whole: str) -> bool:
    """Whether a session is that one or one of its parts."""
    return session == whole or session.startswith(f"{whole}/")


class EndedSessions:
    """The last few that ended, and why."""

    def __init__(self) -> None:
        self._reasons: dict[str, str] = {}

    def ended(self, session: str, reason: str) -> None:
        """Nobody of it is there any more."""
        self._reasons[session] = reason
        if len(self._reasons) > _REMEMBERED:
            del self._reasons[next(iter(self._reasons))]

    def back(self, session: str) -> None:
        """It could not be reached, and is there again."""
        self._reasons.pop(session, None)

    def gone(self, sessions: Iterable[str]) -> SessionEnded | None:
        """Which of these has ended, or the container it is of, as an error; None if all are there."""
        if self._reasons:
            for session in sessions:
                whole = "/".join(session.split("/")[:3])
                if (reason := self._reasons.get(session) or self._reasons.get(whole)) is not None:
                    return SessionEnded(session=session, reason=reason)
        return None
