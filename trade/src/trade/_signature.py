"""One service's arguments and result: described as JSON Schema, validated before provider code runs."""

# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import inspect
import math
import re
import types
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from typing import Any, Final, Literal, Union, get_origin, get_type_hints

import msgspec
from msgspec import UNSET, Raw, UnsetType
from msgspec.structs import astuple

from trade._limits import NOT_FINITE, limits_text, problem_text, value_at
from trade._records import noted
from trade._secret import MASK, is_secret, mask
from trade._service import ServiceMark
from trade._wire import MOST_BYTES, ErrorInfo, Parameter, ServiceInfo
from trade.errors import ConfigurationError, InvalidArgument, InvalidResult, NotSerialisable, TooLarge

_AT: Final = re.compile(r" - at `\$(?:\[(\d+)\]|\.(\w+))(.*)`$")
_MAP_HEADS: Final = frozenset([*range(0x80, 0x90), 0xDE, 0xDF])
_POSITIONAL: Final = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_PLAIN: Final = frozenset([bool, int, float, str, bytes, type(None)])


class Codec:
    """Encoding and decoding of values, with the container's way to turn handles into data and back."""

    def __init__(
        self, enc_hook: Callable[[Any], Any], ext_hook: Callable[[int, memoryview], Any], own: Sequence[type] = ()
    ) -> None:
        self._ext_hook = ext_hook
        self._own = tuple(own)
        """Types that only the hooks know how to send."""
        self.encode: Callable[[Any], bytes] = msgspec.msgpack.Encoder(enc_hook=enc_hook).encode

    def decoder(self, kind: Any) -> Callable[[Any], Any]:
        """A decoder for one type; raises msgspec.ValidationError."""
        return msgspec.msgpack.Decoder(kind, dec_hook=_as_it_is, ext_hook=self._ext_hook).decode

    def schema(self, kind: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """JSON Schema of a type and of the types it refers to; raises TypeError for one that cannot be sent."""
        [schema], definitions = msgspec.json.schema_components([kind], schema_hook=self._own_schema)
        return schema, dict(definitions)

    def _own_schema(self, kind: Any) -> dict[str, Any]:
        if kind not in self._own:
            raise TypeError(f"{_type_text(kind)} is no plain data")
        return {"type": "object", "title": kind.__name__, "x-trade-type": kind.__name__}


def _as_it_is(kind: type, value: Any) -> Any:
    """Values of types msgspec does not know: the ext hook has already made them (handles)."""
    if isinstance(value, kind):
        return value
    raise TypeError(f"Expected `{kind.__name__}`, got `{type(value).__name__}`")


def encode_arguments(
    codec: Codec, info: ServiceInfo, service: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Raw:
    """The caller's half: positional as an array, with keywords as a map of all by name."""
    try:
        data = codec.encode(args if not kwargs else _by_name(info, service, args, kwargs))
    except (TypeError, ValueError, OverflowError, RecursionError) as bad:
        if isinstance(bad, InvalidArgument):
            raise
        raise _unsendable(codec, info, service, args, kwargs, bad) from None
    if len(data) > MOST_BYTES:
        raise TooLarge(service=service, what="arguments", size_bytes=len(data), limit_bytes=MOST_BYTES)
    return Raw(data)


def _by_name(info: ServiceInfo, service: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    places = [parameter.name for parameter in info.parameters if not parameter.keyword_only]
    if len(args) > len(places):
        problem = _too_many(len(places), len(args))
        raise InvalidArgument(service=service, argument="", problem=problem, signature=info.signature)
    named = dict(zip(places, args, strict=False))
    for name in kwargs:
        if name in named:
            raise InvalidArgument(service=service, argument=name, problem="given twice", signature=info.signature)
    return {**named, **kwargs}


def _too_many(places: int, given: int) -> str:
    return f"takes at most {places} positional argument{'' if places == 1 else 's'}, got {given}"


def _unsendable(
    codec: Codec,
    info: ServiceInfo,
    service: str,
    args: tuple[Any, ...],
    kwargs: Mapping[str, Any],
    bad: Exception,
) -> NotSerialisable:
    names = [parameter.name for parameter in info.parameters]
    every = [*zip([*names, *map(str, range(len(args)))], args, strict=False), *kwargs.items()]
    for name, value in every:
        try:
            codec.encode(value)
        except (TypeError, ValueError, OverflowError, RecursionError) as own:
            return NotSerialisable(service=service, what=f"argument {name!r}", problem=str(own))
    return NotSerialisable(service=service, what="the arguments", problem=str(bad))


class Signature:
    """The provider's half, made at registration: decoders, checks and the description."""

    def __init__(self, where: str, name: str, mark: ServiceMark, function: Callable[..., Any], codec: Codec) -> None:
        self._service = where
        hints = _hints(where, function)
        parameters = _parameters(where, function)
        self._names = [parameter.name for parameter in parameters]
        kinds = {parameter.name: hints.get(parameter.name, Any) for parameter in parameters}
        returns = hints.get("return", Any)
        self._secrets = frozenset(name for name, kind in kinds.items() if is_secret(kind))
        self._codec = codec
        self._decode_any = codec.decoder(Any)
        self._decode_array, self._decode_map = self._decoders(where, parameters, kinds, codec)
        self._positional = [p.name for p in parameters if p.kind in _POSITIONAL]
        self._keyword_only = [p.name for p in parameters if p.kind not in _POSITIONAL]
        self._has_defaults = any(p.default is not p.empty for p in parameters)
        self._must_be_finite = mark.effect != "read" and any(_mentions_float(kind) for kind in kinds.values())
        self._result_is_plain = returns if returns is Any or (isinstance(returns, type) and returns in _PLAIN) else None
        self._decode_result = _described(where, "its result", lambda: codec.decoder(returns))
        self.info = _describe(where, name, mark, function, parameters, kinds, returns, codec)

    @staticmethod
    def _decoders(
        where: str, parameters: Sequence[inspect.Parameter], kinds: Mapping[str, Any], codec: Codec
    ) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        fields = [_field(parameter, kinds[parameter.name]) for parameter in parameters]
        places = [field for field, p in zip(fields, parameters, strict=True) if p.kind in _POSITIONAL]

        def build() -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
            array = msgspec.defstruct("Arguments", places, array_like=True, forbid_unknown_fields=True)
            named = msgspec.defstruct("Arguments", fields, kw_only=True, forbid_unknown_fields=True)
            return codec.decoder(array), codec.decoder(named)

        return _described(where, "an argument", build)

    def decode(self, raw: Raw) -> tuple[Sequence[Any], dict[str, Any]]:
        """Validate arguments from the wire. Raises InvalidArgument; no code of the provider has run then."""
        try:
            args, kwargs = self._by_name(raw) if memoryview(raw)[0] in _MAP_HEADS else self._by_place(raw)
        except (msgspec.ValidationError, msgspec.DecodeError) as bad:
            raise self._explain(str(bad), raw) from None
        if self._must_be_finite and not (_finite(args) and _finite(kwargs)):
            raise self._not_finite(args, kwargs)
        return args, kwargs

    def _by_place(self, raw: Raw) -> tuple[Sequence[Any], dict[str, Any]]:
        args = astuple(self._decode_array(raw))
        while args and args[-1] is UNSET:
            args = args[:-1]
        if self._keyword_only:
            self._decode_map(self._codec.encode(dict(zip(self._positional, args, strict=False))))
        return args, {}

    def _by_name(self, raw: Raw) -> tuple[Sequence[Any], dict[str, Any]]:
        struct = self._decode_map(raw)
        args: list[Any] = []
        kwargs: dict[str, Any] = {}
        gap = False
        for name in self._positional:
            value = getattr(struct, name)
            gap = gap or value is UNSET
            if not gap:
                args.append(value)
            elif value is not UNSET:
                kwargs[name] = value
        for name in self._keyword_only:
            if (value := getattr(struct, name)) is not UNSET:
                kwargs[name] = value
        return args, kwargs

    def encode_result(self, value: Any) -> Raw:
        """Check and encode a result. Raises InvalidResult, NotSerialisable: the provider's fault."""
        plain = self._result_is_plain
        try:
            data = self._codec.encode(value)
            if plain is not Any and type(value) is not plain:
                self._decode_result(data)
        except msgspec.ValidationError as bad:
            raise InvalidResult(service=self._service, problem=str(bad)) from None
        except (TypeError, ValueError, OverflowError, RecursionError) as bad:
            raise NotSerialisable(service=self._service, what="its result", problem=str(bad)) from None
        if len(data) > MOST_BYTES:
            raise TooLarge(service=self._service, what="a result", size_bytes=len(data), limit_bytes=MOST_BYTES)
        return Raw(data)

    def encode_progress(self, value: Any) -> Raw:
        """What the provider says of its progress. Raises NotSerialisable, TooLarge: the provider's fault."""
        try:
            data = self._codec.encode(value)
        except (TypeError, ValueError, OverflowError, RecursionError) as bad:
            raise NotSerialisable(service=self._service, what="its progress", problem=str(bad)) from None
        if len(data) > MOST_BYTES:
            raise TooLarge(service=self._service, what="progress", size_bytes=len(data), limit_bytes=MOST_BYTES)
        return Raw(data)

    def copy_progress(self, value: Any) -> Any:
        """The same as a caller on the other side of the wire would get it."""
        return self._decode_any(self.encode_progress(value))

    @property
    def has_secrets(self) -> bool:
        """Whether an argument is secret."""
        return bool(self._secrets)

    def without_secrets(self, error: ErrorInfo, raw: Raw) -> ErrorInfo:
        """An error of a call with these arguments, fit for everybody's eyes."""
        return mask(error, raw, self._positional, self._secrets)

    def copy_result(self, value: Any) -> Any:
        """What a caller on the other side of the wire would get."""
        return self._decode_result(self.encode_result(value))

    def _explain(self, text: str, raw: Raw) -> InvalidArgument:
        at = _AT.search(text)
        if at is not None:
            index, name, rest = at.groups()
            argument = self._positional[int(index)] if index is not None else name
            problem = self._with_value(text[: at.start()], raw, argument, rest) + (f" (at {rest})" if rest else "")
        else:
            argument, problem = self._count_problem(text, raw)
        return InvalidArgument(service=self._service, argument=argument, problem=problem, signature=self.info.signature)

    def _with_value(self, complaint: str, raw: Raw, argument: str, path: str) -> str:
        if argument in self._secrets:
            return complaint
        given: Any = msgspec.msgpack.decode(raw)
        try:
            whole = given[self._positional.index(argument)] if isinstance(given, list) else given[argument]
            return problem_text(complaint, value_at(whole, path))
        except (LookupError, TypeError):
            return complaint

    def _count_problem(self, text: str, raw: Raw) -> tuple[str, str]:
        given: Any = msgspec.msgpack.decode(raw)
        required = [parameter.name for parameter in self.info.parameters if parameter.required]
        if isinstance(given, list):
            count = len(given)  # pyright: ignore[reportUnknownArgumentType]
            missing = [name for name in required if name not in self._positional[:count]]
            if not missing:
                return "", _too_many(len(self._positional), count)
        elif isinstance(given, dict):
            missing = [name for name in required if name not in given]
            unknown = [str(name) for name in given if name not in self._names]  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
            if unknown:
                return unknown[0], "there is no such argument"
        else:
            return "", text
        return (missing[0], "missing") if missing else ("", text)

    def _not_finite(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> InvalidArgument:
        named = [*zip(self._positional, args, strict=False), *kwargs.items()]
        name = next(name for name, value in named if not _finite(value))
        return InvalidArgument(service=self._service, argument=name, problem=NOT_FINITE, signature=self.info.signature)


def _hints(where: str, function: Callable[..., Any]) -> dict[str, Any]:
    try:
        return get_type_hints(function, include_extras=True)
    except Exception as bad:  # noqa: BLE001 - evaluating annotations can raise anything
        problem = f"its annotations cannot be read: {bad}; import the names they use at run time"
        raise ConfigurationError(where=where, problem=problem) from None


def _parameters(where: str, function: Callable[..., Any]) -> list[inspect.Parameter]:
    every = list(inspect.signature(function).parameters.values())
    if every and every[0].name in ("self", "cls"):
        every = every[1:]
    for parameter in every:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            problem = f"a service cannot take {parameter}; name its parameters"
            raise ConfigurationError(where=where, problem=problem)
        if parameter.annotation is parameter.empty:
            name = parameter.name
            problem = f"argument {name!r} has no type hint; write {name}: float, say, or {name}: Any to take anything"
            raise ConfigurationError(where=where, problem=problem)
    return every


def _field(parameter: inspect.Parameter, kind: Any) -> Any:
    if parameter.default is inspect.Parameter.empty:
        return (parameter.name, kind)
    return (parameter.name, kind | UnsetType if kind is not Any else Any, UNSET)


def _described(where: str, what: str, build: Callable[[], Any]) -> Any:
    try:
        return build()
    except TypeError as bad:
        problem = f"{what} has a type that cannot be sent: {bad}; use plain data, a struct, a dataclass or a handle"
        raise ConfigurationError(where=where, problem=problem) from None


def _describe(
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
        _described(where, f"argument {parameter.name!r}", lambda kind=kinds[parameter.name]: codec.schema(kind))
    fields = [_field(parameter, noted(kinds[parameter.name])) for parameter in parameters]
    _, inside = codec.schema(msgspec.defstruct("Arguments", fields, kw_only=True))
    arguments_schema = inside.pop("Arguments")
    result_schema, definitions = _described(where, "its result", lambda: codec.schema(noted(returns)))
    known = {kind.__name__: kind for kind in _types_in(returns, set())}
    definitions = {name: _noted_fields(schema, known.get(name), codec) for name, schema in definitions.items()}
    return ServiceInfo(
        name=name,
        signature=_signature_text(name, parameters, kinds, returns),
        doc=inspect.getdoc(function) or "",
        effect=mark.effect,
        cancel=mark.cancel,
        achieves=mark.achieves,
        uses=mark.uses,
        meta=dict(mark.meta),
        parameters=tuple(_parameter(parameter) for parameter in parameters),
        arguments_schema={**arguments_schema, "$defs": inside} if inside else arguments_schema,
        result_schema={**result_schema, "$defs": definitions} if definitions else result_schema,
        types={name: f"{kind.__module__}:{kind.__qualname__}" for name, kind in known.items()},
    )


def _noted_fields(schema: dict[str, Any], kind: type | None, codec: Codec) -> dict[str, Any]:
    """The schema of a struct with what JSON Schema loses of its fields' types."""
    fields: Sequence[str] = getattr(kind, "__struct_fields__", ())
    if not fields or "properties" not in schema:
        return schema
    sent = dict(zip(fields, kind.__struct_encode_fields__, strict=True))  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    hints = get_type_hints(kind, include_extras=True)
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
        hint = "" if kind is Any else f": {_type_text(kind)}"
        default = _default_text(parameter, hint)
        parts.append(parameter.name + hint + (f" = {MASK}" if default and is_secret(kind) else default))
    if before is inspect.Parameter.POSITIONAL_ONLY:
        parts.append("/")
    return f"{name}({', '.join(parts)})" + ("" if returns is Any else f" -> {_type_text(returns)}")


def _default_text(parameter: inspect.Parameter, hint: str) -> str:
    if parameter.default is parameter.empty:
        return ""
    return f" = {parameter.default!r}" if hint else f"={parameter.default!r}"


def _type_text(kind: Any) -> str:
    """A type as a person would write it: without modules and ``typing``, with its limits in parentheses."""
    if hasattr(kind, "__metadata__"):
        limits = limits_text(kind.__metadata__)
        return _type_text(kind.__origin__) + (f" ({limits})" if limits else "")
    if kind is None or kind is type(None):
        return "None"
    if kind is Ellipsis:
        return "..."
    inner = [_type_text(arg) for arg in getattr(kind, "__args__", ())]
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return " | ".join(inner)
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, kind.__args__))}]"
    name = getattr(origin or kind, "__name__", str(kind))
    return f"{name}[{', '.join(inner)}]" if inner else name


def _types_in(kind: Any, seen: set[int]) -> list[type]:
    """The structs, dataclasses and enums a type mentions, however deep."""
    if id(kind) in seen:
        return []
    seen.add(id(kind))
    found: list[type] = []
    if isinstance(kind, type) and kind.__module__ != "builtins":
        found.append(kind)
        try:
            nested = list(get_type_hints(kind, include_extras=True).values())
        except Exception:  # noqa: BLE001 - foreign classes may have any annotations
            nested = []
    else:
        nested = list(getattr(kind, "__args__", ()))
    for inner in nested:
        found += _types_in(inner, seen)
    return found


def _mentions_float(kind: Any) -> bool:
    if kind is float or kind is Any:
        return True
    if isinstance(kind, type) and kind.__module__ != "builtins":
        return True  # a struct: looked at value by value
    return any(_mentions_float(inner) for inner in getattr(kind, "__args__", ()))


def _finite(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, list | tuple | set | frozenset):
        return all(map(_finite, value))  # pyright: ignore[reportUnknownArgumentType]
    if isinstance(value, dict):
        return all(map(_finite, value.values()))  # pyright: ignore[reportUnknownArgumentType]
    if isinstance(value, msgspec.Struct):
        return all(_finite(getattr(value, name)) for name in value.__struct_fields__)
    if isinstance(value, Decimal):
        return value.is_finite()
    return all(_finite(getattr(value, name)) for name in getattr(value, "__dataclass_fields__", ()))
