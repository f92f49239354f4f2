"""Errors for clients, independent of the protocol: name, HTTP status, message and data."""

from dataclasses import fields
from http import HTTPStatus
from typing import Any, Final

import msgspec
from msgspec import UNSET, Struct, UnsetType

from trade import errors
from trade.errors import TradeError
from trade_gateway.clients._errors import HttpError, Refusal


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
    (errors.AccessDenied, HTTPStatus.FORBIDDEN),
    (errors.NotInstantiable, HTTPStatus.FORBIDDEN),
    (errors.TooLarge, HTTPStatus.REQUEST_ENTITY_TOO_LARGE),
    (errors.SessionEnded, HTTPStatus.NOT_FOUND),
    (errors.NoSuchService, HTTPStatus.NOT_FOUND),
    (errors.NoSuchEstop, HTTPStatus.NOT_FOUND),
    (errors.NoSuchNotification, HTTPStatus.NOT_FOUND),
    (errors.NoSuchHook, HTTPStatus.NOT_FOUND),
    (errors.ServiceGone, HTTPStatus.NOT_FOUND),
    (errors.DeadlineExceeded, HTTPStatus.GATEWAY_TIMEOUT),
    (errors.OutcomeUnknown, HTTPStatus.GATEWAY_TIMEOUT),
    (errors.InvalidArgument, HTTPStatus.BAD_REQUEST),
    (errors.LimitExceeded, HTTPStatus.BAD_REQUEST),
    (errors.NotSerialisable, HTTPStatus.BAD_REQUEST),
    (errors.ConfigurationError, HTTPStatus.BAD_REQUEST),
    (errors.Busy, HTTPStatus.SERVICE_UNAVAILABLE),
    (errors.NoContainerFound, HTTPStatus.SERVICE_UNAVAILABLE),
    (errors.CallerError, HTTPStatus.CONFLICT),
    (errors.CallError, HTTPStatus.BAD_GATEWAY),
    (errors.DeviceError, HTTPStatus.BAD_GATEWAY),
)
"""The first match counts; any other exception of a provider is 500."""


def status_of(error: BaseException) -> int:
    """The HTTP status that describes an error best."""
    if isinstance(error, Refusal):
        return error.status if isinstance(error, HttpError) else error.http_status
    return next((status for kind, status in _STATUS if isinstance(error, kind)), HTTPStatus.INTERNAL_SERVER_ERROR)


def problem_of(error: BaseException) -> Problem:
    """An error for clients, without a traceback."""
    name, status = type(error).__name__, status_of(error)
    if isinstance(error, HttpError):
        return Problem("about:blank", HTTPStatus(status).phrase, status, str(error))
    data = _data(error) if isinstance(error, TradeError) else UNSET
    return Problem(f"urn:trade:{name}", name, status, str(error), data)


def _data(error: TradeError) -> dict[str, Any]:
    shown = {field.name: getattr(error, field.name, None) for field in fields(error) if field.name != "traceback"}
    return msgspec.to_builtins(shown, enc_hook=str)
