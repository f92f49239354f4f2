"""Errors as they leave by the door: ``application/problem+json`` with the error's name, data and remedy."""

from dataclasses import dataclass, fields
from http import HTTPStatus
from typing import Any, Final

import msgspec
from msgspec import UNSET, Struct, UnsetType

from trade import errors
from trade.errors import CallerError, TradeError
from trade_gateway.clients import NoAuditRecord, NoSuchSession, TooMany

MEDIA_TYPE: Final = "application/problem+json"


@dataclass(kw_only=True, eq=False)
class NotLetIn(CallerError, PermissionError):
    """Nobody knows who asks; nothing was done."""

    reason: str

    def describe(self) -> str:
        return f"{self.reason}; show a token (Authorization: Bearer ...), which `trade door token NAME` makes"


@dataclass(kw_only=True, eq=False)
class WrongDoor(CallerError, PermissionError):
    """A page of another site, or somebody under another name of this host; nothing was done."""

    what: str
    remedy: str

    def describe(self) -> str:
        return f"{self.what} is not let in; {self.remedy}"


@dataclass(kw_only=True, eq=False)
class NeedsSession(CallerError, LookupError):
    """What was asked for lives as long as its session, and a plain request has none that lasts."""

    what: str

    def describe(self) -> str:
        return f"{self.what} needs a session: POST /session and send its id as Trade-Session, or speak over /ws"


@dataclass(kw_only=True, eq=False)
class BadMessage(CallerError, ValueError):
    """A body or message is no JSON, or not of the form that belongs here; nothing was done."""

    problem: str

    def describe(self) -> str:
        return f"this cannot be read: {self.problem}; /openapi.json says what belongs here"


@dataclass(kw_only=True, eq=False)
class HttpError(CallerError):
    """What HTTP itself refuses."""

    status: int
    problem: str

    def describe(self) -> str:
        return self.problem


class Problem(Struct, frozen=True, omit_defaults=True):
    """RFC 9457; ``type`` names the error."""

    type: str
    title: str
    status: int
    detail: str
    """What happened and what to do."""
    data: dict[str, Any] | UnsetType = UNSET
    """The error's fields."""


_STATUS: Final[tuple[tuple[type[BaseException], HTTPStatus], ...]] = (
    (NotLetIn, HTTPStatus.UNAUTHORIZED),
    (WrongDoor, HTTPStatus.FORBIDDEN),
    (TooMany, HTTPStatus.TOO_MANY_REQUESTS),
    (errors.AccessDenied, HTTPStatus.FORBIDDEN),
    (errors.NotInstantiable, HTTPStatus.FORBIDDEN),
    (errors.TooLarge, HTTPStatus.REQUEST_ENTITY_TOO_LARGE),
    (NoSuchSession, HTTPStatus.NOT_FOUND),
    (NoAuditRecord, HTTPStatus.NOT_FOUND),
    (errors.SessionEnded, HTTPStatus.NOT_FOUND),
    (NeedsSession, HTTPStatus.BAD_REQUEST),
    (errors.NoSuchService, HTTPStatus.NOT_FOUND),
    (errors.NoSuchEstop, HTTPStatus.NOT_FOUND),
    (errors.ServiceGone, HTTPStatus.NOT_FOUND),
    (errors.DeadlineExceeded, HTTPStatus.GATEWAY_TIMEOUT),
    (errors.OutcomeUnknown, HTTPStatus.GATEWAY_TIMEOUT),
    (errors.InvalidArgument, HTTPStatus.BAD_REQUEST),
    (errors.LimitExceeded, HTTPStatus.BAD_REQUEST),
    (errors.NotSerialisable, HTTPStatus.BAD_REQUEST),
    (errors.ConfigurationError, HTTPStatus.BAD_REQUEST),
    (BadMessage, HTTPStatus.BAD_REQUEST),
    (errors.Busy, HTTPStatus.SERVICE_UNAVAILABLE),
    (errors.NobodyFound, HTTPStatus.SERVICE_UNAVAILABLE),
    (errors.CallerError, HTTPStatus.CONFLICT),
    (errors.CallError, HTTPStatus.BAD_GATEWAY),
    (errors.DeviceError, HTTPStatus.BAD_GATEWAY),
)
"""The first that fits; whatever else a provider raises is 500."""


def status_of(error: BaseException) -> int:
    """The HTTP status that says most of an error."""
    if isinstance(error, HttpError):
        return error.status
    return next((status for kind, status in _STATUS if isinstance(error, kind)), HTTPStatus.INTERNAL_SERVER_ERROR)


def problem_of(error: BaseException) -> Problem:
    """An error as it is told to clients, without a traceback."""
    name, status = type(error).__name__, status_of(error)
    if isinstance(error, HttpError):
        return Problem("about:blank", HTTPStatus(status).phrase, status, str(error))
    data = _data(error) if isinstance(error, TradeError) else UNSET
    return Problem(f"urn:trade:{name}", name, status, str(error), data)


def _data(error: TradeError) -> dict[str, Any]:
    shown = {field.name: getattr(error, field.name, None) for field in fields(error) if field.name != "traceback"}
    return msgspec.to_builtins(shown, enc_hook=str)
