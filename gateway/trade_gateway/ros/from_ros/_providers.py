"""TRADE providers built from ROS types: services whose parameters and results are the fields of messages."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from trade import Resource, service
from trade.errors import ConfigurationError
from trade_gateway.ros_messages._types import Field, Message, Types

_STAMP: Final = "std_msgs/msg/Header"
_OCTETS: Final = ("uint8", "byte", "octet", "char")


class Method(NamedTuple):
    """The description of a service to build."""

    name: str
    doc: str
    parameters: Mapping[str, Any]
    """Types by parameter name."""
    optional: frozenset[str]
    """Optional parameters."""
    returns: Any
    effect: str
    do: Callable[[dict[str, Any]], Any]
    """Takes the arguments by name."""
    cancel: str | None = None


def provider(kind: str, methods: Sequence[Method], resources: Sequence[Resource] = ()) -> object:
    """Builds an object with these services.

    Args:
        kind: name of its class.
        methods: the services.
        resources: what the services that actuate use.
    """
    members: dict[str, Any] = {method.name: _made(method) for method in methods}
    return type(kind, (), {**members, "resources": tuple(resources)})()


def _made(method: Method) -> Any:
    names = list(method.parameters)

    def call(_self: object, *args: Any, **kwargs: Any) -> Any:
        return method.do({**dict(zip(names, args, strict=False)), **kwargs})

    first = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    others = [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY if name in method.optional else inspect.Parameter.POSITIONAL_OR_KEYWORD,
            annotation=kind,
            default=None if name in method.optional else inspect.Parameter.empty,
        )
        for name, kind in sorted(method.parameters.items(), key=lambda item: item[0] in method.optional)
    ]
    call.__name__ = call.__qualname__ = method.name
    call.__doc__ = method.doc
    call.__annotations__ = {**method.parameters, "return": method.returns}
    call.__signature__ = inspect.Signature([first, *others], return_annotation=method.returns)  # pyright: ignore[reportFunctionMemberAccess]
    effect: Any = method.effect
    return service(effect=effect, cancel=method.cancel)(call)


class Records:
    """Message types as structs, built once for each type."""

    def __init__(self, types: Types) -> None:
        self._types = types
        self._structs: dict[str, type[msgspec.Struct]] = {}

    def of(self, type_name: str) -> type[msgspec.Struct]:
        """Returns the struct of a message type; its fields are optional, and zero by default."""
        made = self._structs.get(type_name)
        if made is None:
            fields = [self._field(field) for field in self._types.fields(type_name)]
            package, _, name = type_name.partition("/")
            made = msgspec.defstruct(
                name.rpartition("/")[2], fields, kw_only=True, frozen=True, module=f"ros.{package}"
            )
            self._structs[type_name] = made
        return made

    def parameters(self, type_name: str) -> tuple[dict[str, Any], frozenset[str]]:
        """Returns the fields as parameters of a service, and which are optional: headers.

        Raises:
            ConfigurationError: the name of a field cannot be one of a parameter.
        """
        fields = self._types.fields(type_name)
        for field in fields:
            if not field.name.isidentifier() or field.name == "self":
                raise ConfigurationError(where=type_name, problem=f"{field.name!r} cannot be a parameter")
        headers = frozenset(field.name for field in fields if field.type == _STAMP)
        kinds = {field.name: self._kind(field) for field in fields}
        return {name: kind | None if name in headers else kind for name, kind in kinds.items()}, headers

    def record(self, type_name: str, message: Message) -> Any:
        """Converts a message to the struct of its type; None if it has no fields."""
        return msgspec.convert(message, self.of(type_name)) if message else None

    def _field(self, field: Field) -> tuple[str, Any, Any]:
        kind = self._kind(field)
        if field.many:
            empty: Any = bytes if kind is bytes else list
            return (field.name, kind, msgspec.field(default_factory=empty))
        if "/" in field.type:
            return (field.name, kind, msgspec.field(default_factory=kind))
        return (field.name, kind, kind())

    def _kind(self, field: Field) -> Any:
        if field.many and field.type in _OCTETS:
            return bytes
        one = self.of(field.type) if "/" in field.type else _plain_kind(field.type)
        return list.__class_getitem__(one) if field.many else one


def _plain_kind(kind: str) -> type:
    if kind == "bool":
        return bool
    if kind.endswith("string"):
        return str
    return float if kind.startswith("float") else int


def plain(args: Mapping[str, Any]) -> Message:
    """Converts arguments to a message; the type provides omitted arguments and empty lists."""
    message = msgspec.to_builtins(dict(args), builtin_types=(bytes,))
    return _without_empty(message)


def _without_empty(message: Mapping[str, Any]) -> Message:
    kept: Message = {}
    for name, value in message.items():
        if isinstance(value, dict):
            kept[name] = _without_empty(value)  # pyright: ignore[reportUnknownArgumentType]
        elif value is not None and value != []:
            kept[name] = value
    return kept
