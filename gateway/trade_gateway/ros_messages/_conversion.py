"""Conversion of ROS messages to arguments, and of results to ROS messages, with a check that the two types match."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

import msgspec

from trade import Handle
from trade.errors import ConfigurationError
from trade_gateway.ros_messages._types import Field, Message, Types

_BARE: Final = "data"
"""Common names of the only field of a message."""
_STAMPED: Final = "std_msgs/msg/Header"
_VERDICT: Final = ("success", "message")


class RequestMapping:
    """Converts a message to the arguments of a service."""

    def __init__(
        self,
        types: Types,
        type_name: str,
        handle: Handle,
        args: Mapping[str, str],
        fixed: Mapping[str, Any] | None = None,
    ) -> None:
        """Args:
            types: the types of the ROS side.
            type_name: of the message: a topic's, or of a service's request.
            handle: the service.
            args: for each parameter, its field; not needed for equal names, or for a single field called ``data``.
            fixed: arguments that do not come from the message.

        Raises:
            ConfigurationError: the message and the service do not match.
        """
        self._fixed = dict(fixed or {})
        fields = {field.name: field for field in types.fields(type_name)}
        parameters = {parameter.name: parameter for parameter in handle.record.info.parameters}
        self._from = dict(args)
        where = f"{type_name} for {handle.label}"
        for name in (*args, *self._fixed):
            if name not in parameters:
                problem = f"the service has no parameter {name!r}; it is {handle.signature}"
                raise ConfigurationError(where=where, problem=problem)
        used = {path.partition(".")[0] for path in args.values()}
        open_ones = [name for name in parameters if name not in self._from and name not in self._fixed]
        self._from |= {name: name for name in open_ones if name in fields and name not in used}
        missing = [one for one in open_ones if one not in self._from and parameters[one].required]
        if missing and _BARE in fields and _BARE not in used:
            self._from[missing.pop(0)] = _BARE
        if missing:
            problem = f"no field provides {missing[0]!r}. Name its field in args = {{ {missing[0]} = ... }}"
            raise ConfigurationError(where=where, problem=problem)
        used = {path.partition(".")[0] for path in self._from.values()}
        for name in used - set(fields):
            problem = f"the type has no field {name!r}; it has {', '.join(fields) or 'none'}"
            raise ConfigurationError(where=where, problem=problem)
        self.unused: Final = [name for name in fields if name not in used]
        """Fields that no argument uses."""
        self._check_kinds(where, handle, fields)

    def _check_kinds(self, where: str, handle: Handle, fields: Mapping[str, Field]) -> None:
        properties: Mapping[str, Any] = handle.schema["arguments"].get("properties", {})
        for name, path in self._from.items():
            field = fields.get(path)
            if field is not None and not _takes(properties.get(name, {}), field):
                problem = f"{path!r} is {_said(field)}, which does not fit {name!r}; it is {handle.signature}"
                raise ConfigurationError(where=where, problem=problem)

    def __call__(self, message: Message) -> dict[str, Any]:
        """Returns the arguments by name."""
        return {**self._fixed, **{name: _at(message, path) for name, path in self._from.items()}}


class ResponseMapping:
    """Converts the result of a service to a message."""

    def __init__(self, types: Types, type_name: str, fields: Mapping[str, str] | None = None) -> None:
        """Args:
            types: the types of the ROS side.
            type_name: of the message.
            fields: for each field, the part of the result; by default by equal names, or the only field.

        Raises:
            ConfigurationError: the type has no such field.
        """
        self._type = type_name
        known = {field.name: field.type for field in types.fields(type_name)}
        self._paths = dict(fields or {})
        for path in self._paths:
            if path.partition(".")[0] not in known:
                problem = f"has no field {path!r}; it has {', '.join(known) or 'none'}"
                raise ConfigurationError(where=type_name, problem=problem)
        self._stamped = next((name for name, kind in known.items() if kind == _STAMPED), "")
        self.judges: Final = known.get("success") == "bool"
        """Whether the message has a field for success or failure."""
        self._says = known.get("message") == "string"
        self._names = [name for name in known if name != self._stamped]
        self._free = [name for name in self._names if not (self.judges and name in _VERDICT)]

    def __call__(self, value: Any, at_s: float | None = None) -> Message:
        """Returns the message.

        Args:
            value: the result of the service.
            at_s: its time, in seconds since the epoch, for types with a header.

        Raises:
            ConfigurationError: no part of the value fits the type.
        """
        plain: Any = msgspec.to_builtins(value, enc_hook=str)
        message = self._filled(plain)
        if self.judges:
            verdict: Message = {"success": True}
            if self._says:
                verdict["message"] = "" if plain is None or message else _text(plain)
            message = {**verdict, **message}
        if self._stamped and at_s is not None:
            message.setdefault(self._stamped, {}).setdefault("stamp", ros_stamp(at_s))
        return message

    def _filled(self, plain: Any) -> Message:
        if self._paths:
            message: Message = {}
            for path, source in self._paths.items():
                _put(message, path, _at(plain, source) if source else plain)
            return message
        if isinstance(plain, dict):
            named = cast("dict[str, Any]", plain)
            if found := {name: named[name] for name in self._names if name in named}:
                return found
        if plain is None or not self._free:
            return {}
        if len(self._free) == 1:
            return {self._free[0]: plain}
        problem = f"no field of it ({', '.join(self._free)}) is in {_text(plain)[:80]}. Assign its fields with `fields`"
        raise ConfigurationError(where=self._type, problem=problem)

    def failed(self, error: BaseException) -> Message:
        """Returns the message for a failure; raises the error if the type cannot express one."""
        if not self.judges:
            raise error
        return {"success": False, "message": failure(error)} if self._says else {"success": False}


def failure(error: BaseException) -> str:
    """The text of an error for ROS."""
    return f"{type(error).__name__}: {error}"


def ros_path(group: str, *names: str) -> str:
    """A group and names in it as a name of ROS: ``/rosie/left_arm/stop``."""
    words = [word for text in (group, *names) for word in text.split(".") if word]
    clean = [re.sub(r"\W", "_", word, flags=re.ASCII) for word in words]
    return "/" + "/".join(f"_{word}" if word[0].isdigit() else word for word in clean)


def ros_stamp(at_s: float) -> Message:
    """A time, in seconds since the epoch, as a ROS message."""
    whole = int(at_s // 1)
    return {"sec": whole, "nanosec": min(999_999_999, int((at_s - whole) * 1e9))}


def seconds(stamp: Mapping[str, Any]) -> float:
    """A time or duration of ROS in seconds."""
    return float(stamp["sec"]) + float(stamp["nanosec"]) / 1e9


def _at(value: Any, path: str) -> Any:
    """``position.x``, ``0.position_rad``. Raises ConfigurationError."""
    found: Any = value
    for word in path.split("."):
        try:
            found = found[int(word) if isinstance(found, list) else word]
        except (LookupError, TypeError, ValueError):
            raise ConfigurationError(where=path, problem=f"is not in {_text(value)[:80]}") from None
    return found


def _put(message: Message, path: str, value: Any) -> None:
    *outer, last = path.split(".")
    for word in outer:
        message = message.setdefault(word, {})
    message[last] = value


def _text(value: Any) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value, enc_hook=str).decode()


def _said(field: Field) -> str:
    return f"{field.type}[]" if field.many else field.type


def _kind(field: Field) -> str:
    if field.many:
        return "array"
    if "/" in field.type:
        return "object"
    if field.type == "bool":
        return "boolean"
    if field.type.endswith("string"):
        return "string"
    return "number" if field.type.startswith("float") else "integer"


def _takes(schema: Mapping[str, Any], field: Field) -> bool:
    """Whether a parameter with this JSON Schema accepts a field."""
    options: Sequence[Mapping[str, Any]] = schema.get("anyOf", (schema,))
    kind = _kind(field)
    for one in options:
        known = one.get("type")
        if known is None and "enum" not in one:  # anything, or a record, which is checked on arrival
            return "$ref" not in one or kind in ("object", "string", "integer")
        if kind == known or (kind, known) == ("integer", "number"):
            return True
    return False
