"""Exceptions on their way over the wire and back into the type a caller would catch."""

import builtins
import sys
import traceback
from dataclasses import fields, is_dataclass
from typing import Any, Final

import msgspec

from trade import errors
from trade._wire import ErrorInfo
from trade.errors import RemoteError, TradeError

__all__ = ["pack_error", "unpack_error"]

_MOST_TRACEBACK: Final = 16_000


class RemoteTraceback(Exception):
    """Carries the text of the traceback on the far side, as the cause of the error raised here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def pack_error(error: BaseException) -> ErrorInfo:
    """An exception as data. Values that cannot be sent are sent as their text."""
    kind = type(error)
    data = {f.name: getattr(error, f.name) for f in fields(error)} if is_dataclass(error) else {"args": error.args}
    text = "".join(traceback.format_exception(kind, error, error.__traceback__))
    return ErrorInfo(
        type=f"{kind.__module__}:{kind.__qualname__}",
        message=str(error),
        fields={name: _sendable(value) for name, value in data.items()},
        traceback=text[-_MOST_TRACEBACK:],
    )


def unpack_error(info: ErrorInfo, service: str) -> BaseException:
    """The exception a caller sees: the own type where this process has it, else RemoteError."""
    error = _own(info) or _builtin(info) or _loaded(info)
    if error is None:
        error = RemoteError(service=service, type_name=info.type, message=info.message, traceback=info.traceback)
    if info.traceback:
        error.__cause__ = RemoteTraceback(info.traceback)
    return error


def _sendable(value: Any) -> Any:
    try:
        return msgspec.to_builtins(value)
    except (TypeError, ValueError):
        return str(value)


def _own(info: ErrorInfo) -> BaseException | None:
    """One of our tree: rebuilt with its attributes."""
    found = _find(info.type)
    if not (isinstance(found, type) and issubclass(found, TradeError)):
        return None
    try:
        return found(**info.fields)
    except TypeError:  # another version of the class
        return None


def _builtin(info: ErrorInfo) -> BaseException | None:
    module, _, name = info.type.partition(":")
    found = getattr(builtins, name, None) if module == "builtins" else None
    if not (isinstance(found, type) and issubclass(found, Exception)):
        return None
    try:
        return found(*info.fields.get("args", (info.message,)))
    except TypeError:  # a class that wants more, such as UnicodeDecodeError
        return None


def _loaded(info: ErrorInfo) -> BaseException | None:
    """A class of the user's that is imported here already. Its code does not run: only its arguments are set."""
    found = _find(info.type)
    if not (isinstance(found, type) and issubclass(found, Exception)):
        return None
    try:
        error = found.__new__(found)
    except TypeError:
        return None
    error.args = tuple(info.fields.get("args", (info.message,)))
    return error


def _find(path: str) -> Any:
    module_name, _, qualified = path.partition(":")
    found: Any = errors if module_name == errors.__name__ else sys.modules.get(module_name)
    for part in qualified.split("."):
        found = getattr(found, part, None)
    return found
