"""Types for results whose code a process lacks, made from their JSON Schema.

A result type that is already imported here is used as it is; a message never causes an import.
"""

# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

import dataclasses
import datetime as dt
import decimal
import enum
import sys
import types
import uuid
from collections.abc import Mapping
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, is_typeddict

import msgspec

_PLAIN: Final[dict[str, Any]] = {
    "number": float,
    "integer": int,
    "string": str,
    "boolean": bool,
    "null": None,
}
_MAIN: Final = "__main__"
_NOTE: Final = "x-trade-kind"
_NOTED: Final[dict[str, Any]] = {
    kind.__name__: kind
    for kind in (
        *(tuple, set, frozenset, bytearray, decimal.Decimal, uuid.UUID),
        *(dt.datetime, dt.date, dt.time, dt.timedelta),
    )
}
"""Types for which JSON Schema says only that they are an array or a text."""
_GENERIC: Final[tuple[Any, ...]] = (list, dict, tuple, set, frozenset)
_annotated: Final[Any] = Annotated


def noted(type_: Any) -> Any:
    """The type with a note in its JSON Schema wherever the schema would lose information."""
    origin: Any = get_origin(type_) or type_
    inner = get_args(type_)
    if origin is Annotated:
        return _annotated[(noted(inner[0]), *inner[1:])]
    if origin in (Union, types.UnionType):
        return reduce(or_, map(noted, inner))
    if inner and origin in _GENERIC:
        type_ = origin[tuple(part if part is Ellipsis else noted(part) for part in inner)]
    fixed = origin is tuple and inner and inner[-1] is not Ellipsis
    if fixed or origin not in _NOTED.values():
        return type_
    return _annotated[type_, msgspec.Meta(extra_json_schema={_NOTE: origin.__name__})]


def type_from_schema(schema: Mapping[str, Any], known: Mapping[str, str]) -> Any:
    """The type that a JSON Schema describes.

    Args:
        schema: as msgspec writes it, with definitions under ``$defs``.
        known: definition name -> ``module:qualified name`` of the type it was made from.
    """
    return _Reader(schema.get("$defs", {}), known).read(schema)


class _Reader:
    def __init__(self, definitions: Mapping[str, Any], known: Mapping[str, str]) -> None:
        self._definitions = definitions
        self._known = known
        self._types: dict[str, Any] = {}

    def read(self, schema: Mapping[str, Any]) -> Any:
        if "$ref" in schema:
            return self._definition(schema["$ref"].rsplit("/", 1)[-1])
        if "anyOf" in schema:
            return reduce(or_, [self.read(option) for option in schema["anyOf"]])
        if "enum" in schema:
            return Literal[tuple(schema["enum"])]
        kind = _NOTED.get(schema.get(_NOTE, ""))
        match schema.get("type"):
            case "array":
                return self._array(schema, kind)
            case "object":
                return self._object(schema)
            case "string" if kind is not None:
                return kind
            case "string" if schema.get("contentEncoding") == "base64":
                return bytes
            case str(name) if name in _PLAIN:
                return _PLAIN[name]
            case _:
                return Any

    def _array(self, schema: Mapping[str, Any], type_: Any) -> Any:
        if "prefixItems" in schema:
            return tuple.__class_getitem__(tuple(self.read(item) for item in schema["prefixItems"]))
        item = self.read(schema["items"]) if "items" in schema else Any
        return tuple[item, ...] if type_ is tuple else (type_ or list)[item]

    def _object(self, schema: Mapping[str, Any]) -> Any:
        if "x-trade-type" in schema:  # a value with its own encoding, such as a handle
            return Any
        if "properties" not in schema:
            values = schema.get("additionalProperties", {})
            return dict[Any, self.read(values) if isinstance(values, Mapping) and values else Any]
        return self._record(schema.get("title", "Record"), schema)

    def _definition(self, name: str) -> Any:
        if name not in self._types:
            self._types[name] = Any  # a type that contains itself: its inner occurrences stay plain data
            definition = self._definitions.get(name, {})
            loaded = loaded_type(self._known.get(name, ""))
            self._types[name] = loaded if loaded and _same_fields(loaded, definition) else self.read(definition)
        return self._types[name]

    def _record(self, title: str, schema: Mapping[str, Any]) -> Any:
        required = set(schema.get("required", ()))
        fields = [
            (name, self.read(of)) if name in required else (name, self.read(of) | None, of.get("default"))
            for name, of in schema["properties"].items()
        ]
        try:
            return msgspec.defstruct(title, fields, frozen=True, kw_only=True)
        except (TypeError, ValueError):  # a name that is not an identifier
            return dict[str, Any]


def loaded_type(path: str) -> type | None:
    """The struct, dataclass, enum, named tuple or typed mapping of that name, if this process has imported it."""
    found = imported(path)
    fits = isinstance(found, type) and (
        issubclass(found, msgspec.Struct | enum.Enum)
        or dataclasses.is_dataclass(found)
        or is_typeddict(found)
        or (issubclass(found, tuple) and hasattr(found, "_fields"))
    )
    return found if fits else None


def _same_fields(type_: type, definition: Mapping[str, Any]) -> bool:
    """Whether our type of that name equals the remote one: different programs or versions may use one name."""
    [_], definitions = msgspec.json.schema_components([type_], schema_hook=lambda _: {})
    own = definitions.get(type_.__name__, {})
    return all(set(own.get(part, ())) == set(definition.get(part, ())) for part in ("properties", "required", "enum"))


def name_of(type_: type) -> str:
    """``module:qualified name`` for other processes; types of the main program get the name of its module."""
    module_name = _program() if type_.__module__ == _MAIN else type_.__module__
    return f"{module_name}:{type_.__qualname__}"


def publish(package: str, *kinds: type) -> None:
    """Name types after the package that exports them, where `imported` finds them: a module may move."""
    for kind in kinds:
        kind.__module__ = package
        setattr(sys.modules[package], kind.__name__, kind)


def _program() -> str:
    """The name of the module that runs as ``__main__``."""
    main = sys.modules[_MAIN]
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    return spec.name if spec is not None else Path(file).stem if file else _MAIN


def imported(path: str) -> Any:
    """The object named ``module:qualified name`` in this process; the lookup runs no code, not even a module's."""
    module_name, _, qualified = path.partition(":")
    found: Any = sys.modules.get(module_name)
    if found is None and module_name == _program():
        found = sys.modules[_MAIN]
    for part in qualified.split("."):
        found = getattr(found, "__dict__", {}).get(part)
    return found
