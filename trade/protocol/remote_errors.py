"""Converts exceptions to their wire form and back to the type that a caller would catch."""

import traceback
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Final

import msgspec
from msgspec import structs

from trade.errors import RemoteError, TradeError
from trade.protocol.messages import ErrorInfo
from trade.protocol.schema_types import imported, name_of

_MOST_TRACEBACK: Final = 16_000


class RemoteTraceback(Exception):
    """The text of the remote traceback, as the cause of the error raised here."""

    def __init__(self, info: ErrorInfo) -> None:
        super().__init__(info.traceback)
        self.info: Final = info
        """The error in its wire form."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def pack_error(error: BaseException) -> ErrorInfo:
    """An exception as data. Values that cannot be sent are sent as text; it never fails."""
    kind = type(error)
    return ErrorInfo(
        type=name_of(kind),
        message=_text(error),
        fields={name: _sendable(value) for name, value in _data(error).items()},
        traceback=_traceback(error)[-_MOST_TRACEBACK:],
    )


def passed_on(error: BaseException) -> ErrorInfo:
    """An error from elsewhere in its original form, whether or not its type is known here; without a traceback."""
    cause = error.__cause__
    info = cause.info if isinstance(cause, RemoteTraceback) else pack_error(error)
    return structs.replace(info, traceback="")


def _data(error: BaseException) -> dict[str, Any]:
    """The data of an exception: the fields of our own types, the arguments and attributes of others."""
    if isinstance(error, TradeError):
        return {f.name: getattr(error, f.name, None) for f in fields(error)}
    args = error.__reduce__()[1] if isinstance(error, OSError) else error.args  # args would lack the file's name
    return {**vars(error), "args": [_sendable(argument) for argument in args]}


def _text(value: Any) -> str:
    try:
        text = str(value)
    except Exception:  # noqa: BLE001 - the user's own `__str__`
        text = f"<{type(value).__qualname__} without a text>"
    return text.encode(errors="backslashreplace").decode()


def _traceback(error: BaseException) -> str:
    try:
        return _text("".join(traceback.format_exception(error)))
    except Exception:  # noqa: BLE001 - it prints values of user types
        return ""


def unpack_error(info: ErrorInfo, service: str) -> BaseException:
    """The exception that a caller sees: its own type where this process has it, else RemoteError."""
    error = _rebuilt(info)
    if error is None:
        error = RemoteError(service=service, type_name=info.type, message=info.message, traceback=info.traceback)
    if info.traceback or isinstance(error, RemoteError):
        error.__cause__ = RemoteTraceback(info)
    return error


def _sendable(value: Any) -> Any:
    try:
        return msgspec.msgpack.decode(msgspec.msgpack.encode(value))
    except Exception:  # noqa: BLE001 - the value is anything
        return _text(value)


def _rebuilt(info: ErrorInfo) -> BaseException | None:
    """The exception in its own type, if this process has the type and can create it from the data."""
    found = imported(info.type)
    if not (isinstance(found, type) and issubclass(found, Exception)):
        return None
    try:
        if issubclass(found, TradeError):
            checked = msgspec.convert(info.fields, found, strict=False)
            return found(**{f.name: getattr(checked, f.name) for f in fields(found)})
        args = info.fields.get("args", (info.message,))
        return found(*args) if found.__module__ == "builtins" else _users(found, args, info.fields)
    except Exception:  # noqa: BLE001 - another version of the class, or one that is made differently
        return None


def _users(found: type[Exception], args: Sequence[Any], attributes: Mapping[str, Any]) -> Exception:
    """An exception of a user's class, with its arguments and attributes; the class's own code is not run."""
    error = found.__new__(found)
    error.args = tuple(args)
    error.__dict__.update({name: value for name, value in attributes.items() if name != "args"})
    return error
