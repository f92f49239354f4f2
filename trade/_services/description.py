"""The public description of a service, read from its method: signature, schemas, types."""

# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_type_hints

import msgspec
from msgspec import UNSET, UnsetType

from trade._services.decorator import ServiceMark
from trade._services.secret import MASK, is_secret
from trade.errors import ConfigurationError
from trade.protocol.codec import Codec
from trade.protocol.messages import Parameter, ServiceInfo
from trade.protocol.schema import schema_message, type_text
from trade.protocol.schema_types import name_of, noted


def field_of(parameter: inspect.Parameter, type_: Any) -> Any:
    if parameter.default is inspect.Parameter.empty:
        return (parameter.name, type_)
    return (parameter.name, type_ | UnsetType if type_ is not Any else Any, UNSET)


def described(where: str, what: str, build: Callable[[], Any]) -> Any:
    try:
        return build()
    except TypeError as bad:
        problem = f"{what} has a type that cannot be sent: {bad}; use plain data, a struct, a dataclass or a handle"
        raise ConfigurationError(where=where, problem=problem) from None


def describe(
    where: str,
    name: str,
    mark: ServiceMark,
    function: Callable[..., Any],
    parameters: Sequence[inspect.Parameter],
    kinds: Mapping[str, Any],
    returns: Any,
    codec: Codec,
) -> ServiceInfo:
    for parameter in parameters:
        described(where, f"argument {parameter.name!r}", lambda kind=kinds[parameter.name]: codec.schema(kind))
    fields = [field_of(parameter, noted(kinds[parameter.name])) for parameter in parameters]
    _, inside = codec.schema(msgspec.defstruct("Arguments", fields, kw_only=True))
    arguments_schema = inside.pop("Arguments")
    result_schema, definitions = described(where, "its result", lambda: codec.schema(noted(returns)))
    known = {kind.__name__: kind for kind in _types_in(returns, set())}
    definitions = {name: _noted_fields(schema, known.get(name), codec) for name, schema in definitions.items()}
    return ServiceInfo(
        name=name,
        signature=_signature_text(name, parameters, kinds, returns),
        doc=inspect.getdoc(function) or "",
        effect=mark.effect,
        cancel=mark.cancel,
        needs=mark.needs,
        achieves=mark.achieves,
        uses=mark.uses,
        meta=dict(mark.meta),
        parameters=tuple(_parameter(parameter) for parameter in parameters),
        arguments_schema=schema_message(arguments_schema, inside),
        result_schema=schema_message(result_schema, definitions),
        types={name: name_of(kind) for name, kind in known.items()},
    )


def _noted_fields(schema: dict[str, Any], type_: type | None, codec: Codec) -> dict[str, Any]:
    """The schema of a struct with the field types that JSON Schema cannot express."""
    fields: Sequence[str] = getattr(type_, "__struct_fields__", ())
    if not fields or "properties" not in schema:
        return schema
    sent = dict(zip(fields, type_.__struct_encode_fields__, strict=True))  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    hints = get_type_hints(type_, include_extras=True)
    properties = {
        sent[name]: {**schema["properties"][sent[name]], **codec.schema(noted(hints[name]))[0]}
        for name in fields
        if sent[name] in schema["properties"]
    }
    return {**schema, "properties": {**schema["properties"], **properties}}


def _parameter(parameter: inspect.Parameter) -> Parameter:
    return Parameter(
        parameter.name,
        required=parameter.default is parameter.empty,
        keyword_only=parameter.kind is parameter.KEYWORD_ONLY,
        positional_only=parameter.kind is parameter.POSITIONAL_ONLY,
    )


def _signature_text(name: str, parameters: Sequence[inspect.Parameter], kinds: Mapping[str, Any], returns: Any) -> str:
    parts: list[str] = []
    before = None
    for parameter in parameters:
        if before is parameter.POSITIONAL_ONLY and parameter.kind is not before:
            parts.append("/")
        if parameter.kind is parameter.KEYWORD_ONLY and before is not parameter.kind:
            parts.append("*")
        before = parameter.kind
        kind = kinds[parameter.name]
        hint = "" if kind is Any else f": {type_text(kind)}"
        default = _default_text(parameter, hint)
        parts.append(parameter.name + hint + (f" = {MASK}" if default and is_secret(kind) else default))
    if before is inspect.Parameter.POSITIONAL_ONLY:
        parts.append("/")
    return f"{name}({', '.join(parts)})" + ("" if returns is Any else f" -> {type_text(returns)}")


def _default_text(parameter: inspect.Parameter, hint: str) -> str:
    if parameter.default is parameter.empty:
        return ""
    return f" = {parameter.default!r}" if hint else f"={parameter.default!r}"


def _types_in(type_: Any, seen: set[int]) -> list[type]:
    """The structs, dataclasses and enums that a type mentions, at any depth."""
    if id(type_) in seen:
        return []
    seen.add(id(type_))
    found: list[type] = []
    if isinstance(type_, type) and type_.__module__ != "builtins":
        found.append(type_)
        try:
            nested = list(get_type_hints(type_, include_extras=True).values())
        except Exception:  # noqa: BLE001 - foreign classes may have any annotations
            nested = []
    else:
        nested = list(getattr(type_, "__args__", ()))
    for inner in nested:
        found += _types_in(inner, seen)
    return found
