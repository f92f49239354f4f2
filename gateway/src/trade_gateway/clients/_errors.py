"""What the HTTP API and the tools of agents refuse, each with its HTTP status."""

from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import ClassVar

from trade.errors import CallerError


class Refusal(CallerError):
    """A request that was not carried out."""

    http_status: ClassVar[HTTPStatus] = HTTPStatus.CONFLICT


@dataclass(kw_only=True, eq=False)
class TooMany(Refusal, BlockingIOError):
    """More at once than is taken from one client, or from all; nothing was done."""

    http_status = HTTPStatus.TOO_MANY_REQUESTS
    what: str
    limit: int

    def describe(self) -> str:
        return f"there are {self.limit} {self.what} already, which is the limit; end some, or try again later"


@dataclass(kw_only=True, eq=False)
class NoSuchSession(Refusal, LookupError):
    """There is no such session of this client; nothing was done, and what it had set moving was told to stop."""

    http_status = HTTPStatus.NOT_FOUND
    session: str
    """How the id begins that was sent."""

    def describe(self) -> str:
        return (
            f"this client has no session {self.session}...: it was closed, or nothing was heard of it within its "
            "lease; POST /session opens another one"
        )


@dataclass(kw_only=True, eq=False)
class NoAuditRecord(Refusal, LookupError):
    """This host keeps no audit record."""

    http_status = HTTPStatus.NOT_FOUND

    def describe(self) -> str:
        return "no audit record is kept; TRADE_AUDIT=FOLDER keeps one"


@dataclass(kw_only=True, eq=False)
class NotLetIn(Refusal, PermissionError):
    """Nobody knows who asks; nothing was done."""

    http_status = HTTPStatus.UNAUTHORIZED
    reason: str

    def describe(self) -> str:
        return f"{self.reason}; show a token (Authorization: Bearer ...), which `trade door token NAME` makes"


@dataclass(kw_only=True, eq=False)
class WrongDoor(Refusal, PermissionError):
    """A page of another site, or somebody under another name of this host; nothing was done."""

    http_status = HTTPStatus.FORBIDDEN
    what: str
    remedy: str

    def describe(self) -> str:
        return f"{self.what} is not let in; {self.remedy}"


@dataclass(kw_only=True, eq=False)
class NeedsSession(Refusal, LookupError):
    """What was asked for lives as long as its session, and a plain request has none that lasts."""

    http_status = HTTPStatus.BAD_REQUEST
    what: str

    def describe(self) -> str:
        return f"{self.what} needs a session: POST /session and send its id as Trade-Session, or speak over /ws"


@dataclass(kw_only=True, eq=False)
class BadMessage(Refusal, ValueError):
    """A body or message is no JSON, or not of the form that belongs here; nothing was done."""

    http_status = HTTPStatus.BAD_REQUEST
    problem: str

    def describe(self) -> str:
        return f"this cannot be read: {self.problem}; /openapi.json says what belongs here"


@dataclass(kw_only=True, eq=False)
class HttpError(Refusal):
    """What HTTP itself refuses."""

    status: int
    problem: str

    def describe(self) -> str:
        return self.problem


@dataclass(kw_only=True, eq=False)
class NeedsLock(Refusal, PermissionError):
    """An agent moves only what it has locked; nothing was done."""

    service: str
    resources: Sequence[str]

    def describe(self) -> str:
        return f"{self.service} uses {', '.join(self.resources)}; take a lock over its group first (tool lock)"


@dataclass(kw_only=True, eq=False)
class NeedsApproval(Refusal, PermissionError):
    """A person who was asked did not say yes; nothing was done."""

    service: str
    reason: str

    def describe(self) -> str:
        return f"{self.service} needs somebody's approval: {self.reason}"


@dataclass(kw_only=True, eq=False)
class NoTwin(Refusal, LookupError):
    """There is nothing to try it on; nothing was done."""

    reason: str

    def describe(self) -> str:
        return f"{self.reason}; start the server with --twin ROBOT.toml for a simulated one"


@dataclass(kw_only=True, eq=False)
class WrongTool(Refusal, ValueError):
    """The arguments of a tool are wrong; nothing was done."""

    problem: str

    def describe(self) -> str:
        return self.problem


@dataclass(kw_only=True, eq=False)
class NoSuchTool(Refusal, LookupError):
    """There is no such tool."""

    name: str
    known: Sequence[str]

    def describe(self) -> str:
        return f"there is no tool {self.name!r}; there is {', '.join(self.known)}"
