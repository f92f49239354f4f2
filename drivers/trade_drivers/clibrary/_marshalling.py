"""Conversion of a method's arguments and results to those of a C function, planned once at declaration."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from math import isfinite
from typing import Any, Final, NamedTuple, get_args, get_origin, get_type_hints

from trade.errors import ConfigurationError

_NONE: Final = type(None)
_FLOATS: Final = ("float", "double", "long double")
_TEXTS: Final = ("char *", "char const *")

Into = Callable[[Any], Sequence[Any]]
"""Converts an argument to one or two C arguments."""
OutOf = Callable[[Any], Any]


class _OutParameter(NamedTuple):
    """A result that C writes through a pointer."""

    type: str
    length: int
    """The count passed after the pointer; 0 if there is none."""
    read: OutOf


class Passing(NamedTuple):
    """The conversion plan of one function."""

    ffi: Any
    into_c: Sequence[Into]
    backs: Sequence[_OutParameter]
    returned: OutOf | None
    """Converts the return value; None if it is not the result."""
    has_status: bool

    def into(self, first: Sequence[Any], args: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Returns the C arguments, and those of them that receive results."""
        given = list(first)
        for put, value in zip(self.into_c, args, strict=True):
            given.extend(put(value))
        places = [self.ffi.new(one.type) for one in self.backs]
        for one, place in zip(self.backs, places, strict=True):
            given.extend((place, one.length) if one.length else (place,))
        return given, places

    def out_of(self, returned: Any, places: Sequence[Any]) -> Any:
        """Returns the method's result."""
        if self.returned is not None:
            return self.returned(returned)
        results = [one.read(place) for one, place in zip(self.backs, places, strict=True)]
        return tuple(results) if len(results) > 1 else results[0] if results else None


def plan(
    ffi: Any,
    where: str,
    type_: Any,
    hints: Mapping[str, Any],
    *,
    status: bool | None,
    handle: bool,
    lengths: Sequence[int],
) -> Passing:
    """See `CLibrary.function`; the hints are the method's, with its result. Raises ConfigurationError."""
    planned = _Planning(ffi, where, list(type_.args)[handle:], list(lengths))
    for name, hint in hints.items():
        if name != "return":
            planned.take(name, hint)
    result = hints["return"]
    returns_more = type_.result.kind != "void" and (bool(planned.kinds) or result is _NONE)
    has_status = returns_more if status is None else status
    if has_status and _python(type_.result) not in (int, bool):
        remedy = "; status=False throws it away" if status is None else ""
        raise planned.wrong(f"it returns {type_.result.cname}, which is no status{remedy}")
    by_value = not planned.kinds and result is not _NONE
    returned = planned.reads(type_.result, result, "its result") if by_value else None
    return Passing(ffi, planned.into_c, [] if by_value else planned.give_back(result), returned, has_status)


class _Planning:
    """Matches the parameters of both sides, one after the other."""

    def __init__(self, ffi: Any, where: str, kinds: list[Any], lengths: list[int]) -> None:
        self._ffi = ffi
        self._where = where
        self.kinds = kinds
        """Parameters of the C function that are not yet matched."""
        self._lengths = lengths
        self.into_c: list[Into] = []

    def wrong(self, problem: str) -> ConfigurationError:
        return ConfigurationError(where=self._where, problem=problem)

    # --- arguments

    def take(self, name: str, hint: Any) -> None:
        """Matches the next parameter of the method."""
        if not self.kinds:
            raise self.wrong(f"the function has no parameter for {name}")
        kind = self.kinds.pop(0)
        put = self._several(kind, hint) if get_origin(hint) is list else self._one(kind, hint, name)
        if put is None:
            counted = "; that needs a pointer and a count after it" if get_origin(hint) is list else ""
            raise self.wrong(f"{name} is {_named(hint)}, the function takes {kind.cname}{counted}")
        self.into_c.append(put)

    def _one(self, type_: Any, hint: Any, name: str) -> Into | None:
        if hint is str and type_.cname in _TEXTS:
            return lambda value: (self._ffi.new("char[]", _text(value)),)
        if type_.cname == "float" and hint is float:
            return lambda value: (_fits(value, self._ffi.cast("float", value)),)
        if hint in (_python(type_), *((bool,) if _python(type_) is int else ())):
            return lambda value: (value,)
        if type_.kind != "struct" or not is_dataclass(hint):
            return None
        self._struct(type_, hint, name)
        members, made = [field.name for field in fields(hint)], f"{type_.cname} *"
        if missing := [one for one, _ in type_.fields or () if one not in members]:
            raise self.wrong(f"{_named(hint)} has no {', '.join(missing)}, which {type_.cname} has")

        def put(value: Any) -> Sequence[Any]:
            given = {one: getattr(value, one) for one in members}
            struct = self._ffi.new(made, given)
            for one, number in given.items():
                _fits(number, getattr(struct, one))
            return (struct[0],)

        return put

    def _several(self, type_: Any, hint: Any) -> Into | None:
        if type_.kind != "pointer" or not self._is_count() or get_args(hint) != (_python(type_.item),):
            return None
        self.kinds.pop(0)
        made = f"{type_.item.cname}[]"

        def put(values: Sequence[Any]) -> Sequence[Any]:
            array = self._ffi.new(made, list(values))
            for value, held in zip(values, array, strict=True):
                _fits(value, held)
            return array, len(values)

        return put

    def _is_count(self) -> bool:
        return bool(self.kinds) and self.kinds[0].kind == "primitive" and _python(self.kinds[0]) is int

    # --- results

    def give_back(self, result: Any) -> list[_OutParameter]:
        """Matches all remaining parameters with the method's result."""
        backs: list[_OutParameter] = []
        several = get_origin(result) is tuple
        wanted = [*get_args(result)] if several else [] if result is _NONE else [result]
        while self.kinds:
            if not wanted:
                raise self.wrong(f"nothing is given for its parameter {self.kinds[0].cname}")
            backs.append(self._back(self.kinds.pop(0), wanted.pop(0)))
        if wanted or self._lengths:
            raise self.wrong(f"the function gives {len(backs)} values back, the method returns {_named(result)}")
        return backs

    def _back(self, type_: Any, hint: Any) -> _OutParameter:
        if type_.kind != "pointer" or type_.item.kind not in ("primitive", "enum", "struct"):
            raise self.wrong(f"nothing is given for its parameter {type_.cname}, and nothing can come back by that")
        if get_origin(hint) is not list:
            read = self.reads(type_.item, hint, "what comes back")

            def first(place: Any) -> Any:
                return read(place[0])

            return _OutParameter(f"{type_.item.cname} *", 0, first)
        if not self._lengths:
            raise self.wrong(f"say by out=... how many come back by its parameter {type_.cname}")
        length, read = self._lengths.pop(0), self.reads(type_.item, get_args(hint)[0], "what comes back")
        counted = self._is_count()
        if counted:
            self.kinds.pop(0)

        def each(place: Any) -> list[Any]:
            return [read(one) for one in place]

        return _OutParameter(f"{type_.item.cname}[{length}]", length if counted else 0, each)

    def reads(self, type_: Any, hint: Any, what: str) -> OutOf:
        """Returns the conversion of a C value to Python."""
        if hint is str and type_.cname in _TEXTS:
            return lambda value: "" if value == self._ffi.NULL else self._ffi.string(value).decode(errors="replace")
        if type_.kind == "struct" and is_dataclass(hint):
            return self._struct(type_, hint, what)
        if hint is bool and _python(type_) in (int, bool):
            return bool
        if _python(type_) is hint:
            return _itself
        raise self.wrong(f"{what} is {type_.cname}, which cannot be {_named(hint)}")

    def _struct(self, type_: Any, hint: Any, what: str) -> OutOf:
        has, wanted = dict(type_.fields or ()), get_type_hints(hint)
        if missing := wanted.keys() - has.keys():
            raise self.wrong(f"{type_.cname} has no {', '.join(sorted(missing))}, which {_named(hint)} has")
        reads = {name: self.reads(has[name].type, one, f"{what}.{name}") for name, one in wanted.items()}
        return lambda value: hint(**{name: read(getattr(value, name)) for name, read in reads.items()})


def _python(type_: Any) -> type | None:
    """Returns the Python type of a C number."""
    if type_.kind == "enum":
        return int
    if type_.kind != "primitive" or type_.cname in ("char", "wchar_t"):
        return None
    return bool if type_.cname == "_Bool" else float if type_.cname in _FLOATS else int


def is_never_negative(type_: Any) -> bool:
    """Returns whether a C number type has no values below zero, so that none can mean failure."""
    if type_.kind == "enum":
        return min(type_.elements, default=0) >= 0
    return type_.cname.startswith(("uint", "unsigned")) or type_.cname == "size_t"


def _fits(value: Any, held: Any) -> Any:
    """Returns the value; raises OverflowError if it is infinite as a C float."""
    if isinstance(value, float) and isfinite(value) and not isfinite(float(held)):
        raise OverflowError(f"{value} is more than a float of C holds")
    return value


def _text(value: str) -> bytes:
    data = value.encode()
    if b"\0" in data:
        raise ValueError("a text of C ends at the first zero byte; it may have none within")
    return data


def _itself(value: Any) -> Any:
    return value


def _named(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint)
