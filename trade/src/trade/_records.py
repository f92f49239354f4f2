"""Types of results a process has no code for, made from their JSON Schema.

A result type that is already imported here is used as it is; nothing is ever imported because a message says so.
"""

# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

import dataclasses
import enum
import sys
from collections.abc import Mapping
from functools import reduce
from operator import or_
from typing import Any, Final, Literal

import msgspec

_PLAIN: Final[dict[str, Any]] = {
    "number": float,
    "integer": int,
    "string": str,
    "boolean": bool,
    "null": None,
}


def type_from_schema(schema: Mapping[str, Any], known: Mapping[str, str]) -> Any:
    """The type a JSON Schema describes.

    Args:
        schema: as msgspec writes it, definitions under ``$defs``.
        known: definition name -> ``module:qualified name`` of the type it was made from.
    """
    return _Reader(schema.get("$defs", {}), known).read(schema)


class _Reader:
    def __init__(self, definitions: Mapping[str, Any], known: Mapping[str, str]) -> None:
        self._definitions = definitions
        self._known = known
        self._made: dict[str, Any] = {}

    def read(self, schema: Mapping[str, Any]) -> Any:
        if "$ref" in schema:
            return self._definition(schema["$ref"].rsplit("/", 1)[-1])
        if "anyOf" in schema:
            return reduce(or_, [self.read(option) for option in schema["anyOf"]])
        if "enum" in schema:
            return Literal[tuple(schema["enum"])]
        match schema.get("type"):
            case "array":
                return self._array(schema)
            case "object":
                return self._object(schema)
            case "string" if schema.get("contentEncoding") == "base64":
                return bytes
            case str(name) if name in _PLAIN:
                return _PLAIN[name]
            case _:
                return Any

    def _array(self, schema: Mapping[str, Any]) -> Any:
        if "prefixItems" in schema:
            return tuple.__class_getitem__(tuple(self.read(item) for item in schema["prefixItems"]))
        return list[self.read(schema["items"])] if "items" in schema else list[Any]

    def _object(self, schema: Mapping[str, Any]) -> Any:
        if "x-trade-type" in schema:  # a value with an encoding of its own, such as a handle
            return Any
        if "properties" not in schema:
            values = schema.get("additionalProperties", {})
            return dict[str, self.read(values)] if isinstance(values, Mapping) and values else dict[Any, Any]
        return self._record(schema.get("title", "Record"), schema)

    def _definition(self, name: str) -> Any:
        if name not in self._made:
            self._made[name] = Any  # a type that contains itself: its inner occurrences stay plain data
            self._made[name] = loaded_type(self._known.get(name, "")) or self.read(self._definitions.get(name, {}))
        return self._made[name]

    def _record(self, title: str, schema: Mapping[str, Any]) -> Any:
        required = set(schema.get("required", ()))
        fields = [
            (name, self.read(of)) if name in required else (name, self.read(of) | None, of.get("default"))
            for name, of in schema["properties"].items()
        ]
        try:
            return msgspec.defstruct(title, fields, frozen=True, kw_only=True)
        except (TypeError, ValueError):  # a name that is no identifier
            return dict[str, Any]


def loaded_type(path: str) -> type | None:
    """The struct, dataclass or enum of that name, if this process has imported it already."""
    module_name, _, qualified = path.partition(":")
    found: Any = sys.modules.get(module_name)
    for part in qualified.split("."):
        found = getattr(found, part, None)
    fits = isinstance(found, type) and (
        issubclass(found, msgspec.Struct | enum.Enum) or dataclasses.is_dataclass(found)
    )
    return found if fits else None
