"""What clients are refused, whichever way they ask."""

from dataclasses import dataclass

from trade.errors import CallerError


@dataclass(kw_only=True, eq=False)
class TooMany(CallerError, BlockingIOError):
    """More at once than is taken from one client, or from all; nothing was done."""

    what: str
    limit: int

    def describe(self) -> str:
        return f"there are {self.limit} {self.what} already, which is the limit; end some, or try again later"


@dataclass(kw_only=True, eq=False)
class NoSuchSession(CallerError, LookupError):
    """There is no such session of this client; nothing was done, and what it had set moving was told to stop."""

    session: str
    """How the id begins that was sent."""

    def describe(self) -> str:
        return (
            f"this client has no session {self.session}...: it was closed, or nothing was heard of it within its "
            "lease; POST /session opens another one"
        )


@dataclass(kw_only=True, eq=False)
class NoAuditRecord(CallerError, LookupError):
    """This host keeps no audit record."""

    def describe(self) -> str:
        return "no audit record is kept; TRADE_AUDIT=FOLDER keeps one"
