"""Types as JSON Schema text, and whether values of one schema are valid under another one."""

# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false

import math
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, Literal, Union, get_origin

import msgspec
from msgspec import Meta, Raw

from trade.errors import ConfigurationError
from trade.protocol.messages import NO_SCHEMA, encode_message
from trade.protocol.schema_types import noted

# The schemas came over the wire: they have no types.
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false


NOT_FINITE: Final = "must be finite: no NaN, no infinity"

_STEP: Final = re.compile(r"\[(\d+)\]|\.(\w+)")
_LONGEST_TEXT: Final = 60


def limits_text(notes: tuple[object, ...]) -> str:
    """What the notes of an ``Annotated`` type allow, such as ``0 to 1``; empty if they limit nothing."""
    metas = [note for note in notes if isinstance(note, Meta)]
    return ", ".join(part for meta in metas for part in _limits(meta))


def _limits(meta: Meta) -> Iterator[str]:
    if meta.ge is not None and meta.le is not None:
        yield f"{meta.ge:g} to {meta.le:g}"
    else:
        bounds = ((">=", meta.ge), ("<=", meta.le))
        yield from (f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)
    strict = ((">", meta.gt), ("<", meta.lt))
    yield from (f"{sign} {bound:g}" for sign, bound in strict if bound is not None)
    if meta.multiple_of is not None:
        yield f"a multiple of {meta.multiple_of:g}"
    lengths = (("at least", meta.min_length), ("at most", meta.max_length))
    yield from (f"{most} {length} long" for most, length in lengths if length is not None)
    if meta.pattern is not None:
        yield f"matching {meta.pattern!r}"


def value_at(given: Any, path: str) -> Any:
    """The part of an argument that a path of msgspec, such as ``[1].x_m``, points to.

    Raises:
        LookupError: the path does not lead to one value.
    """
    place = 0
    while place < len(path):
        step = _STEP.match(path, place)
        if step is None:
            raise LookupError(path)
        given = given[int(step[1])] if step[1] is not None else given[step[2]]
        place = step.end()
    return given


def problem_text(complaint: str, value: Any) -> str:
    """What is wrong with a value: the validation message, with the value where that does not show it."""
    if isinstance(value, float) and not math.isfinite(value):
        return NOT_FINITE
    if ", got " in complaint or not complaint.startswith("Expected "):
        return complaint
    shown = repr(value)
    return f"{complaint}, but is {shown if len(shown) <= _LONGEST_TEXT else shown[:_LONGEST_TEXT] + '...'}"


_Schema = Mapping[str, Any]
_NAMES: Final = {"number": "float", "integer": "int", "string": "str", "boolean": "bool", "null": "None"}
_SAME: Final = ("format", "contentEncoding", "x-trade-type", "x-trade-kind")
"""Keys that distinguish kinds of values of the same JSON type."""
_MOST_REFERENCES: Final = 100
_decode_schema: Final = msgspec.msgpack.Decoder(dict[str, Any]).decode


def types_text(kinds: Sequence[Any]) -> str:
    """The JSON Schemas of types, as one canonical text; raises ConfigurationError for a type that cannot be sent."""
    try:
        schemas, definitions = msgspec.json.schema_components([noted(kind) for kind in kinds], schema_hook=_own_schema)
    except TypeError as bad:
        raise ConfigurationError(problem=f"this type cannot be sent, so no service has it: {bad}") from None
    return msgspec.json.encode([list(schemas), definitions], order="sorted").decode()


def _own_schema(type_: Any) -> dict[str, Any]:
    name = getattr(type_, "__trade_type__", None)
    if name is None:
        raise TypeError(f"{type_!r} is no plain data")
    return {"type": "object", "title": name, "x-trade-type": name}


@lru_cache(1024)
def read_types(text: str) -> tuple[tuple[_Schema, ...], _Schema]:
    """The schemas in such a text, and the definitions they refer to. Raises ValueError for another text."""
    schemas, definitions = read_json(text, tuple[list[dict[str, Any]], dict[str, Any]])
    return tuple(schemas), definitions


def schema_message(schema: _Schema, definitions: _Schema) -> Raw:
    """A schema in its wire form, with the definitions it refers to."""
    if not schema and not definitions:
        return NO_SCHEMA  # which is omitted
    return Raw(encode_message({**schema, "$defs": definitions} if definitions else schema))


def read_schema(raw: Raw) -> dict[str, Any]:
    """Decodes a schema from its wire form, as a new object each time; an unreadable one describes nothing."""
    try:
        return _decode_schema(raw)
    except (msgspec.DecodeError, ValueError, RecursionError):
        return {}


@lru_cache(1024)
def known_schema(data: bytes) -> _Schema:
    """The same, cached: for reading only."""
    return read_schema(Raw(data))


def read_json(text: str, type_: Any) -> Any:
    """A JSON text as one type; raises ValueError for another text."""
    try:
        return msgspec.json.decode(text, type=type_)
    except msgspec.DecodeError as bad:
        raise ValueError(str(bad)) from None


def readable(text: str) -> str:
    """Such a text in the notation of a person."""
    return f"[{', '.join(map(schema_name, read_types(text)[0]))}]"


def schema_name(schema: _Schema) -> str:
    """A type in the notation of a person, by its JSON Schema."""
    if "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[-1]
    if "anyOf" in schema:
        return " | ".join(map(schema_name, schema["anyOf"]))
    if "enum" in schema:
        return f"Literal[{', '.join(map(repr, schema['enum']))}]"
    kind = schema.get("type")
    if kind == "array":
        return f"list[{schema_name(schema['items'])}]" if schema.get("items") else "list"
    if kind == "object":
        return str(schema.get("title", "dict"))
    return str(schema.get("format") or ("bytes" if "contentEncoding" in schema else _NAMES.get(str(kind), "Any")))


def type_text(type_: Any) -> str:
    """A type in the notation of a person: without modules and ``typing``, with its limits in parentheses."""
    if hasattr(type_, "__metadata__"):
        limits = limits_text(type_.__metadata__)
        return type_text(type_.__origin__) + (f" ({limits})" if limits else "")
    if type_ is None or type_ is type(None):
        return "None"
    if type_ is Ellipsis:
        return "..."
    inner = [type_text(arg) for arg in getattr(type_, "__args__", ())]
    origin = get_origin(type_)
    if origin in (Union, types.UnionType):
        return " | ".join(inner)
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, type_.__args__))}]"
    name = getattr(origin or type_, "__name__", str(type_))
    return f"{name}[{', '.join(inner)}]" if inner else name


def fits(given: _Schema, given_definitions: _Schema, wanted: _Schema, wanted_definitions: _Schema) -> bool:
    """Whether every value of the given schema is of the wanted type; ranges and lengths are not compared.

    Schemas come from other containers and may be anything; an invalid one fits nothing.
    """
    try:
        return _Comparison(given_definitions, wanted_definitions).fits(given, wanted)
    except (TypeError, ValueError, LookupError, AttributeError, RecursionError):
        return False


class _Comparison:
    def __init__(self, given_definitions: _Schema, wanted_definitions: _Schema) -> None:
        self._given_definitions = given_definitions
        self._wanted_definitions = wanted_definitions
        self._known: dict[tuple[int, int], bool] = {}

    def fits(self, given: _Schema, wanted: _Schema) -> bool:
        given, wanted = _resolved(given, self._given_definitions), _resolved(wanted, self._wanted_definitions)
        pair = (id(given), id(wanted))
        if pair not in self._known:
            self._known[pair] = True  # a type that contains itself fits unless something else does not
            self._known[pair] = self._compare(given, wanted)
        return self._known[pair]

    def _compare(self, given: _Schema, wanted: _Schema) -> bool:
        if "anyOf" in given:
            return all(self.fits(option, wanted) for option in given["anyOf"])
        if "anyOf" in wanted:
            return any(self.fits(given, option) for option in wanted["anyOf"])
        if "enum" in given:
            return all(_is_of(value, wanted) for value in given["enum"])
        if _means_anything(wanted):
            return True
        kind = wanted.get("type")
        same = given.get("type") == kind or (given.get("type"), kind) == ("integer", "number")
        if "enum" in wanted or not same:
            return False
        if kind == "array":  # a list, a tuple and a set have one wire form
            return self._array(given, wanted)
        if any(given.get(part) != wanted.get(part) for part in _SAME):
            return False
        return kind != "object" or self._object(given, wanted)

    def _array(self, given: _Schema, wanted: _Schema) -> bool:
        items: Sequence[_Schema] = wanted.get("prefixItems", ())
        given_items: Sequence[_Schema] = given.get("prefixItems", ())
        rest, own_rest = wanted.get("items", {}), given.get("items", {})
        least = given.get("minItems", 0) if given_items else 0
        if least < wanted.get("minItems", 0) and items:
            return False
        if own_rest is False:
            return all(self._item_fits(item, items, rest, index) for index, item in enumerate(given_items))
        return not items and rest is not False and all(self.fits(item, rest) for item in (*given_items, own_rest))

    def _item_fits(self, item: _Schema, items: Sequence[_Schema], rest: Any, index: int) -> bool:
        if index < len(items):
            return self.fits(item, items[index])
        return rest is not False and self.fits(item, rest)

    def _object(self, given: _Schema, wanted: _Schema) -> bool:
        own: _Schema = given.get("properties", {})
        if "properties" not in wanted:
            values = _values(wanted)
            return all(self.fits(value, values) for value in (*own.values(), *_open_values(given)))
        if "properties" not in given:
            return False
        wanted_names = set(wanted["properties"])
        missing = set(wanted.get("required", ())) - set(given.get("required", ()))
        if missing or (wanted_names and not wanted_names & set(own)):  # nothing in common, though nothing is required
            return False
        return all(self.fits(own[name], value) for name, value in wanted["properties"].items() if name in own)


def _resolved(schema: _Schema, definitions: _Schema) -> _Schema:
    for _ in range(_MOST_REFERENCES):
        if "$ref" in schema:
            schema = definitions[schema["$ref"].rsplit("/", 1)[-1]]
        elif "allOf" in schema:
            [schema] = schema["allOf"]
        else:
            return schema
    raise ValueError("a reference to itself")


def _means_anything(schema: _Schema) -> bool:
    return not any(part in schema for part in ("type", "enum", "anyOf", *_SAME))


_ANYTHING: Final[_Schema] = {}


def _values(schema: _Schema) -> _Schema:
    values = schema.get("additionalProperties", _ANYTHING)
    return values if isinstance(values, Mapping) else _ANYTHING


def _open_values(given: _Schema) -> Sequence[_Schema]:
    """The types of a mapping's values beside its named ones; a record has none."""
    return () if "properties" in given else (_values(given),)


def _is_of(value: Any, wanted: _Schema) -> bool:
    """Whether one plain value is of a type."""
    if _means_anything(wanted):
        return True
    if "enum" in wanted:
        return any(value == other and type(value) is type(other) for other in wanted["enum"])
    if any(part in wanted for part in _SAME):
        return False
    kinds = {bool: ("boolean",), int: ("integer", "number"), float: ("number",), str: ("string",)}
    return wanted.get("type") in kinds.get(type(value), ("null",) if value is None else ())
