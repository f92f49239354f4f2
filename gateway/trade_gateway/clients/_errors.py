"""The errors of the HTTP API and of agents' tools, each with its HTTP status."""

from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import ClassVar

from trade.errors import CallerError


class Refusal(CallerError):
    """A request that was not executed."""

    http_status: ClassVar[HTTPStatus] = HTTPStatus.CONFLICT


@dataclass(kw_only=True, eq=False)
class TooMany(Refusal, BlockingIOError):
    """A limit of one client, or of all, is reached; nothing was done."""

    http_status = HTTPStatus.TOO_MANY_REQUESTS
    what: str
    limit: int

    def describe(self) -> str:
        return f"there are {self.limit} {self.what} already, which is the limit. End some, or try again later"


@dataclass(kw_only=True, eq=False)
class NoSuchSession(Refusal, LookupError):
    """This client has no such session. Nothing was done; the motion of a session that has ended stops."""

    http_status = HTTPStatus.NOT_FOUND
    session: str
    """The first characters of the id that was sent."""

    def describe(self) -> str:
        return (
            f"this client has no session {self.session}...: it was closed, or it expired after its lease without a "
            "request. Open another one: POST /session, or `initialize` over MCP"
        )


@dataclass(kw_only=True, eq=False)
class NoAuditRecord(Refusal, LookupError):
    """This host keeps no audit record."""

    http_status = HTTPStatus.NOT_FOUND

    def describe(self) -> str:
        return "no audit record is kept. TRADE_AUDIT=FOLDER enables it"


@dataclass(kw_only=True, eq=False)
class NoPolicyFile(Refusal, LookupError):
    """This HTTP gateway has no policy."""

    http_status = HTTPStatus.NOT_FOUND

    def describe(self) -> str:
        return "this HTTP gateway has no policy. Start it with TRADE_POLICY=FILE"


@dataclass(kw_only=True, eq=False)
class NotAuthenticated(Refusal, PermissionError):
    """The client cannot be identified; nothing was done."""

    http_status = HTTPStatus.UNAUTHORIZED
    reason: str

    def describe(self) -> str:
        return f"{self.reason}. Send a token (Authorization: Bearer ...), which `trade http token NAME` creates"


@dataclass(kw_only=True, eq=False)
class WrongOrigin(Refusal, PermissionError):
    """The request came from a page of another site, or names another host; nothing was done."""

    http_status = HTTPStatus.FORBIDDEN
    what: str
    remedy: str

    def describe(self) -> str:
        return f"{self.what} is refused; {self.remedy}"


@dataclass(kw_only=True, eq=False)
class NeedsSession(Refusal, LookupError):
    """The operation needs a session that outlives its request; a plain request has none."""

    http_status = HTTPStatus.BAD_REQUEST
    what: str

    def describe(self) -> str:
        return f"{self.what} needs a session. POST /session and send its id as Trade-Session, or connect to /ws"


@dataclass(kw_only=True, eq=False)
class BadMessage(Refusal, ValueError):
    """A body or message is not JSON, or has the wrong structure; nothing was done."""

    http_status = HTTPStatus.BAD_REQUEST
    problem: str

    def describe(self) -> str:
        return f"this cannot be read: {self.problem}. /openapi.json describes the valid messages"


@dataclass(kw_only=True, eq=False)
class HttpError(Refusal):
    """An error of HTTP itself."""

    status: int
    problem: str

    def describe(self) -> str:
        return self.problem


@dataclass(kw_only=True, eq=False)
class NeedsLock(Refusal, PermissionError):
    """An agent moves only resources that it has locked; nothing was done."""

    service: str
    resources: Sequence[str]

    def describe(self) -> str:
        return f"{self.service} uses {', '.join(self.resources)}. Lock its group first with the tool `lock`"


@dataclass(kw_only=True, eq=False)
class NeedsApproval(Refusal, PermissionError):
    """No person has approved the call; nothing was done."""

    service: str
    reason: str

    def describe(self) -> str:
        return f"{self.service} needs a person's approval: {self.reason}"


@dataclass(kw_only=True, eq=False)
class NoTwin(Refusal, LookupError):
    """There is no simulated twin for a dry run; nothing was done."""

    reason: str

    def describe(self) -> str:
        return f"{self.reason}. Start the server with --twin ROBOT.toml for a simulated one"


@dataclass(kw_only=True, eq=False)
class WrongTool(Refusal, ValueError):
    """The arguments of a tool are wrong; nothing was done."""

    problem: str

    def describe(self) -> str:
        return self.problem


@dataclass(kw_only=True, eq=False)
class NoSuchTool(Refusal, LookupError):
    """This tool does not exist."""

    name: str
    known: Sequence[str]

    def describe(self) -> str:
        return f"there is no tool {self.name!r}. Use one of {', '.join(self.known)}"
