"""One method's arguments and result on the provider's side: validated before its code runs, encoded after."""

# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from typing import Any, Final, get_type_hints
from weakref import WeakValueDictionary

import msgspec
from msgspec import UNSET, Raw
from msgspec.structs import astuple

from trade._services.decorator import ServiceMark
from trade._services.description import describe, described, field_of
from trade._services.secret import MASK, is_secret, mask
from trade.errors import ConfigurationError, InvalidArgument, InvalidResult, NotSerialisable, TooLarge
from trade.protocol.codec import Codec
from trade.protocol.messages import LARGE, MOST_BYTES, UNREADABLE, ErrorInfo, LargeBytes, ServiceInfo
from trade.protocol.schema import NOT_FINITE, problem_text, value_at

_AT: Final = re.compile(r" - at `\$(?:\[(\d+)\]|\.(\w+))(.*)`$")
_MAP_HEADS: Final = frozenset([*range(0x80, 0x90), 0xDE, 0xDF])
_POSITIONAL: Final = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_PLAIN: Final = frozenset([bool, int, float, str, bytes, type(None)])
_SEVERAL: Final = (list, tuple, set, frozenset)
_SAME_WHEN_COPIED: Final = (bool, float, type(None))
"""Types whose values can all be sent, and arrive unchanged."""


_infos: Final[WeakValueDictionary[tuple[str, ServiceMark, Callable[..., Any]], ServiceInfo]] = WeakValueDictionary()
"""Cached descriptions of methods. Used for the middleware's own, which every container has and which do not change."""


class Signature:
    """Checks and converts the arguments and the result of a service method, and describes both as JSON Schema.

    All objects that share the method share one. Each use passes the service's name, for errors.
    """

    def __init__(self, where: str, name: str, mark: ServiceMark, function: Callable[..., Any], codec: Codec) -> None:
        hints = _hints(where, function)
        parameters = _parameters(where, function)
        self._names = [parameter.name for parameter in parameters]
        types = {parameter.name: hints.get(parameter.name, Any) for parameter in parameters}
        returns = hints.get("return", Any)
        self._secrets = frozenset(name for name, kind in types.items() if is_secret(kind))
        self.has_secrets = bool(self._secrets)
        """Whether an argument is secret."""
        self._codec = codec
        self._decode_any = codec.decoder(Any)
        self._positional = [p.name for p in parameters if p.kind in _POSITIONAL]
        self._keyword_only = [p.name for p in parameters if p.kind not in _POSITIONAL]
        self._all_given = not self._keyword_only and all(p.default is p.empty for p in parameters)
        self._decode_array, self._decode_map = self._decoders(where, parameters, types)
        self._must_be_finite = mark.effect != "read" and any(_mentions_float(kind) for kind in types.values())
        self._is_finite = math.isfinite if all(_is_number(kind) for kind in types.values()) else _finite
        self._result_is_plain = returns if returns is Any or (isinstance(returns, type) and returns in _PLAIN) else None
        self._result_is_itself = returns if returns in _SAME_WHEN_COPIED else None
        self._decode_result = described(where, "its result", lambda: codec.decoder(returns))
        key = (name, mark, function)
        # Code executed from text may have no module.
        known = _infos.get(key) if (function.__module__ or "").startswith("trade.") else None
        self.info = known or describe(where, name, mark, function, parameters, types, returns, codec)
        _infos[key] = self.info

    def _decoders(
        self, where: str, parameters: Sequence[inspect.Parameter], types: Mapping[str, Any]
    ) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        fields = [field_of(parameter, types[parameter.name]) for parameter in parameters]
        positional = [field for field, p in zip(fields, parameters, strict=True) if p.kind in _POSITIONAL]

        def build() -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
            array: Any = tuple.__class_getitem__(tuple(types[name] for name in self._positional))
            if not self._all_given:
                array = msgspec.defstruct("Arguments", positional, array_like=True, forbid_unknown_fields=True)
            named = msgspec.defstruct("Arguments", fields, kw_only=True, forbid_unknown_fields=True)
            return self._codec.decoder(array), self._codec.decoder(named)

        return described(where, "an argument", build)

    def decode(self, service: str, raw: Raw | bytes) -> tuple[Sequence[Any], dict[str, Any]]:
        """Validate arguments from the wire. Raises InvalidArgument before any code of the provider runs."""
        try:
            head = raw[0] if type(raw) is bytes else memoryview(raw)[0]
            args, kwargs = self._by_name(raw) if head in _MAP_HEADS else (self._by_place(raw), {})
            if self._must_be_finite and not (all(map(self._is_finite, args)) and (not kwargs or _finite(kwargs))):
                raise self._not_finite(service, args, kwargs)
        except UNREADABLE as bad:
            raise self._explain(service, bad, raw) from None
        return args, kwargs

    def _by_place(self, raw: Raw | bytes) -> Sequence[Any]:
        given = self._decode_array(raw)
        if self._all_given:
            return given
        args = astuple(given)
        while args and args[-1] is UNSET:
            args = args[:-1]
        if self._keyword_only:
            self._decode_map(self._codec.encode(dict(zip(self._positional, args, strict=False))))
        return args

    def _by_name(self, raw: Raw | bytes) -> tuple[Sequence[Any], dict[str, Any]]:
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

    def encode_result(self, service: str, value: Any) -> bytes:
        """Check and encode a result. Raises InvalidResult, NotSerialisable, TooLarge: defects of the provider."""
        plain = self._result_is_plain
        try:
            data = self._codec.encode(value)
            if plain is not Any and type(value) is not plain:
                self._decode_result(data)
        except msgspec.ValidationError as bad:
            raise InvalidResult(service=service, problem=str(bad)) from None
        except (TypeError, ValueError, OverflowError, RecursionError) as bad:
            raise NotSerialisable(service=service, what="its result", problem=str(bad)) from None
        if len(data) > MOST_BYTES:
            raise TooLarge(service=service, what="a result", size_bytes=len(data), limit_bytes=MOST_BYTES)
        return data

    def encode_body(self, service: str, value: Any) -> Raw | LargeBytes:
        """The same for an answer, in which large bytes are not copied."""
        if type(value) is bytes and LARGE <= len(value) < MOST_BYTES - 8 and self._result_is_plain in (bytes, Any):
            return LargeBytes(value)
        return Raw(self.encode_result(service, value))

    def copy_result(self, service: str, value: Any) -> Any:
        """The result as a remote caller would get it."""
        if type(value) is self._result_is_itself:
            return value
        return self._decode_result(self.encode_result(service, value))

    def encode_progress(self, service: str, value: Any) -> bytes:
        """Encode a progress value. Raises NotSerialisable, TooLarge: defects of the provider."""
        try:
            data = self._codec.encode(value)
        except (TypeError, ValueError, OverflowError, RecursionError) as bad:
            raise NotSerialisable(service=service, what="its progress", problem=str(bad)) from None
        if len(data) > MOST_BYTES:
            raise TooLarge(service=service, what="progress", size_bytes=len(data), limit_bytes=MOST_BYTES)
        return data

    def copy_progress(self, service: str, value: Any) -> Any:
        """The progress value as a remote caller would get it."""
        return self._decode_any(self.encode_progress(service, value))

    def named(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """Arguments by name, with secrets masked."""
        given = {**dict(zip(self._positional, args, strict=False)), **kwargs}
        return {name: MASK if name in self._secrets else value for name, value in given.items()}

    def without_secrets(self, error: ErrorInfo, raw: Raw | bytes) -> ErrorInfo:
        """An error of a call with these arguments, with secrets masked."""
        return mask(error, raw, self._positional, self._secrets)

    def _explain(self, service: str, bad: Exception, raw: Raw | bytes) -> InvalidArgument:
        try:
            return self._explained(service, str(bad), raw)
        except UNREADABLE as worse:
            problem = "nested too deeply" if isinstance(worse, RecursionError) else str(worse)
            return InvalidArgument(service=service, argument="", problem=problem, signature=self.info.signature)

    def _explained(self, service: str, text: str, raw: Raw | bytes) -> InvalidArgument:
        at = _AT.search(text)
        if at is not None:
            index, name, rest = at.groups()
            argument = self._positional[int(index)] if index is not None else name
            problem = self._with_value(text[: at.start()], raw, argument, rest) + (f" (at {rest})" if rest else "")
        else:
            argument, problem = self._count_problem(text, raw)
        return InvalidArgument(service=service, argument=argument, problem=problem, signature=self.info.signature)

    def _with_value(self, complaint: str, raw: Raw | bytes, argument: str, path: str) -> str:
        if argument in self._secrets:
            return complaint
        given: Any = msgspec.msgpack.decode(raw)
        try:
            whole = given[self._positional.index(argument)] if isinstance(given, list) else given[argument]
            return problem_text(complaint, value_at(whole, path))
        except (LookupError, TypeError):
            return complaint

    def _count_problem(self, text: str, raw: Raw | bytes) -> tuple[str, str]:
        given: Any = msgspec.msgpack.decode(raw)
        required = [parameter.name for parameter in self.info.parameters if parameter.required]
        if isinstance(given, list):
            count = len(given)  # pyright: ignore[reportUnknownArgumentType]
            missing = [name for name in required if name not in self._positional[:count]]
            if not missing:
                return "", too_many(len(self._positional), count)
        elif isinstance(given, dict):
            missing = [name for name in required if name not in given]
            unknown = [str(name) for name in given if name not in self._names]  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
            if unknown:
                return unknown[0], "there is no such argument"
        else:
            return "", text
        return (missing[0], "missing") if missing else ("", text)

    def _not_finite(self, service: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> InvalidArgument:
        named = [*zip(self._positional, args, strict=False), *kwargs.items()]
        name = next(name for name, value in named if not _finite(value))
        return InvalidArgument(service=service, argument=name, problem=NOT_FINITE, signature=self.info.signature)


def too_many(positional: int, given: int) -> str:
    return f"takes at most {positional} positional argument{'' if positional == 1 else 's'}, got {given}"


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


def _is_number(type_: Any) -> bool:
    """Whether a type accepts numbers only, limited or not."""
    return getattr(type_, "__origin__", type_) in (float, int, bool)


def _mentions_float(type_: Any) -> bool:
    if type_ is float or type_ is Any:
        return True
    if isinstance(type_, type) and type_.__module__ != "builtins":
        return True  # a struct: checked value by value
    return any(_mentions_float(inner) for inner in getattr(type_, "__args__", ()))


def _finite(value: Any) -> bool:
    kind = type(value)
    if kind is float:
        return math.isfinite(value)
    if kind in _PLAIN:
        return True
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, _SEVERAL):
        return all(map(_finite, value))
    if isinstance(value, dict):
        return all(map(_finite, value.values()))  # pyright: ignore[reportUnknownArgumentType]
    if isinstance(value, msgspec.Struct):
        return all(_finite(getattr(value, name)) for name in value.__struct_fields__)
    if isinstance(value, Decimal):
        return value.is_finite()
    return all(_finite(getattr(value, name)) for name in getattr(value, "__dataclass_fields__", ()))
