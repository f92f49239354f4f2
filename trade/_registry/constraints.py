"""``where``: conditions on services with and, or, not, in disjunctive normal form; plain data that can be sent."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Any, Final, Literal, Protocol

import msgspec
from msgspec import Struct

from trade._registry.predicates import fits_all, parse_predicates
from trade.errors import ConfigurationError
from trade.protocol.keys import GROUP
from trade.protocol.messages import Scalar, ServiceInfo
from trade.protocol.schema import fits, known_schema, read_json, read_types, readable, types_text

"""The form of a group: whole segments joined by dots."""
_MOST_CLAUSES: Final = 1000
_GLOB: Final = frozenset("*?[")
_Field = Literal[
    "name",
    "group",
    "host",
    "container",
    "local",
    "args",
    "returns",
    "needs",
    "achieves",
    "uses",
    "kind",
    "meta",
    "healthy",
]


class Candidate(Protocol):
    """The properties of a service that a constraint tests."""

    @property
    def name(self) -> str: ...
    @property
    def groups(self) -> Sequence[str]: ...
    @property
    def host(self) -> str: ...
    @property
    def container(self) -> str: ...
    @property
    def local(self) -> bool: ...
    @property
    def info(self) -> ServiceInfo: ...
    @property
    def kinds(self) -> Sequence[str]: ...
    @property
    def meta(self) -> Mapping[str, Scalar]: ...
    @property
    def healthy(self) -> bool: ...


class Term(Struct, frozen=True, array_like=True, order=True):
    """One test: a field against a pattern.

    Patterns are texts: names and groups as they are, types as JSON Schema, predicates, a key and its value as JSON.
    """

    field: _Field
    pattern: str
    negated: bool = False

    def __post_init__(self) -> None:
        """Validates terms from messages like terms from code."""
        match self.field:
            case "args" | "returns":
                schemas, _ = read_types(self.pattern)
                if self.field == "returns" and len(schemas) != 1:
                    raise ValueError("a service returns one result")
            case "needs" | "achieves":
                parse_predicates(self.pattern)
            case "meta":
                _key_and_value(self.pattern)
            case "group":
                _check_group(self.pattern)
            case "uses":
                _check_no_pattern(self.field, self.pattern)
            case _:
                pass

    def __invert__(self) -> "Term":
        return Term(self.field, self.pattern, not self.negated)

    def matches(self, candidate: Candidate) -> bool:
        return self._holds(candidate) is not self.negated

    def _holds(self, candidate: Candidate) -> bool:
        match self.field:
            case "local" | "healthy":
                return bool(getattr(candidate, self.field))
            case "group":
                return any(under(group, self.pattern) for group in candidate.groups)
            case "uses":
                return any(under(resource, self.pattern) for resource in candidate.info.uses)
            case "kind":
                return any(_like(kind, self.pattern) for kind in candidate.kinds)
            case "args":
                return _takes(candidate.info, self.pattern)
            case "returns":
                return _returns(candidate.info, self.pattern)
            case "needs" | "achieves":
                return fits_all(getattr(candidate.info, self.field), parse_predicates(self.pattern))
            case "meta":
                key, value = _key_and_value(self.pattern)
                return key in candidate.meta and _same(candidate.meta[key], value)
            case "name" | "host" | "container":
                return _like(getattr(candidate, self.field), self.pattern)

    def __str__(self) -> str:
        return f"not {self._text()}" if self.negated else self._text()

    def _text(self) -> str:
        match self.field:
            case "local" | "healthy":
                return self.field
            case "args":
                return f"args={readable(self.pattern)}"
            case "returns":
                return f"returns={readable(self.pattern)[1:-1]}"
            case "meta":
                key, value = _key_and_value(self.pattern)
                return f"meta {key}={value!r}"
            case _:
                return f"{self.field}={self.pattern!r}"


def _check_group(group: str) -> None:
    _check_no_pattern("group", group)
    if not GROUP.fullmatch(group):
        raise ConfigurationError(problem=f"group={group!r} is no group; use words joined by dots, such as rosie.head")


def _check_no_pattern(field: str, text: str) -> None:
    if is_exact(text):
        return
    whole = re.split(r"\.?[^.]*[*?\[]", text)[0]
    problem = (
        f"{field}={text!r} would match nothing: name whole dotted segments; each name includes everything beneath it"
    )
    raise ConfigurationError(problem=f"{problem}; write {field}={whole!r}" if whole else f"{problem}, as rosie does")


def under(group: str, selected: str) -> bool:
    """Whether a dotted group is the selected one or beneath it; by whole segments only."""
    return group == selected or group.startswith(selected + ".")


def is_exact(pattern: str) -> bool:
    """Whether a pattern matches only one name."""
    return _GLOB.isdisjoint(pattern)


def _like(name: str, pattern: str) -> bool:
    return name == pattern or fnmatchcase(name, pattern)


def _takes(info: ServiceInfo, pattern: str) -> bool:
    """Whether the service accepts this number of positional arguments of these types."""
    given, definitions = read_types(pattern)
    places = [parameter for parameter in info.parameters if not parameter.keyword_only]
    left_out = [parameter for parameter in info.parameters if parameter not in places[: len(given)]]
    if len(given) > len(places) or any(parameter.required for parameter in left_out):
        return False
    whole = known_schema(bytes(info.arguments_schema))
    properties, own = whole.get("properties", {}), whole.get("$defs", {})
    return all(
        not schema or fits(schema, definitions, properties.get(place.name, {}), own)  # {} is Any: of whatever type
        for schema, place in zip(given, places, strict=False)
    )


def _returns(info: ServiceInfo, pattern: str) -> bool:
    [wanted], definitions = read_types(pattern)
    given = known_schema(bytes(info.result_schema))
    return fits(given, given.get("$defs", {}), wanted, definitions)


@lru_cache(1024)
def _key_and_value(pattern: str) -> tuple[str, Scalar]:
    return read_json(pattern, tuple[str, Scalar])


def _same(one: Scalar, other: Scalar) -> bool:
    """Whether two values are equal, where true is not 1."""
    return one == other and isinstance(one, bool) is isinstance(other, bool)


class Constraint(Struct, frozen=True):
    """A disjunction of conjunctions of terms. Combine with ``&``, ``|``, ``~``."""

    clauses: tuple[frozenset[Term], ...]

    def __and__(self, other: "Constraint") -> "Constraint":
        return _normal([left | right for left in self.clauses for right in other.clauses])

    def __or__(self, other: "Constraint") -> "Constraint":
        return _normal([*self.clauses, *other.clauses])

    def __invert__(self) -> "Constraint":
        result = Constraint((frozenset(),))
        for clause in self.clauses:
            result &= _normal([frozenset((~term,)) for term in clause])
        return result

    def __bool__(self) -> bool:
        raise TypeError("a constraint is neither true nor false; combine with & | ~ instead of and, or, not")

    def matches(self, candidate: Candidate) -> bool:
        """Whether a service meets the constraint."""
        return any(all(term.matches(candidate) for term in clause) for clause in self.clauses)

    def __str__(self) -> str:
        if not self.clauses:
            return "nothing"
        texts = [" and ".join(str(term) for term in sorted(clause)) or "everything" for clause in self.clauses]
        return texts[0] if len(texts) == 1 else " or ".join(f"({text})" for text in texts)


def _normal(clauses: Sequence[frozenset[Term]]) -> Constraint:
    """Drops clauses that contradict themselves or that another clause implies."""
    if len(clauses) > _MOST_CLAUSES:
        raise ConfigurationError(problem=f"this constraint has more than {_MOST_CLAUSES} alternatives; make it simpler")
    sound = {clause for clause in clauses if not any(~term in clause for term in clause)}
    return Constraint(tuple(clause for clause in sorted(sound, key=sorted) if not any(c < clause for c in sound)))


class _Where:
    """Makes constraints; see ``where``."""

    local: Final = Constraint((frozenset((Term("local", ""),)),))
    """Services of this container."""
    healthy: Final = Constraint((frozenset((Term("healthy", ""),)),))
    """Services whose provider reports that it is healthy."""

    def __call__(
        self,
        *,
        name: str | None = None,
        group: str | None = None,
        host: str | None = None,
        container: str | None = None,
        local: bool | None = None,
        args: Sequence[Any] | None = None,
        returns: Any = msgspec.UNSET,
        needs: str | Sequence[str] | None = None,
        achieves: str | Sequence[str] | None = None,
        uses: str | None = None,
        kind: str | None = None,
        meta: Mapping[str, Scalar] | None = None,
        healthy: bool | None = None,
    ) -> Constraint:
        """Services that meet all given conditions; without any: all services.

        Args:
            name: the service's name; ``*`` and ``?`` are wildcards.
            group: a dotted group; includes everything beneath it.
            host: the computer's name; ``*`` and ``?`` allowed.
            container: the container's name; ``*`` and ``?`` allowed.
            local: whether the service runs in this container.
            args: types of positional arguments that it accepts; ``[]`` is a call without arguments. ``int`` fits
                ``float``, and a struct fits one with a subset of its required fields; ``Any`` fits every type.
            returns: the type of its result, or one that fits it; ``None`` is a service without a result.
            needs: a predicate that one of its pre-conditions must fit; ``?x`` is a variable. Of several, each must
                fit one, and a variable has one meaning in all of them.
            achieves: the same, for its post-conditions.
            uses: a physical resource; includes everything beneath it.
            kind: name of its provider's class, or of a base or interface of it; ``*`` and ``?`` allowed.
            meta: keys and values of its metadata.
            healthy: whether its provider reports that it is healthy.

        Raises:
            ConfigurationError: a pattern is empty or not allowed there, a type cannot be sent, or a predicate is
                malformed.
        """
        given: tuple[tuple[_Field, str | None], ...]
        given = (("name", name), ("group", group), ("host", host), ("container", container))
        given = (*given, ("uses", uses), ("kind", kind))
        terms = [Term(field, _pattern(field, pattern)) for field, pattern in given if pattern is not None]
        flags: tuple[tuple[_Field, bool | None], ...] = (("local", local), ("healthy", healthy))
        terms += [Term(field, "", negated=not flag) for field, flag in flags if flag is not None]
        if args is not None:
            terms.append(Term("args", types_text(_checked_types(args))))
        if returns is not msgspec.UNSET:
            terms.append(Term("returns", types_text([returns])))
        conditions: tuple[tuple[_Field, str | Sequence[str] | None], ...] = (("needs", needs), ("achieves", achieves))
        terms += [Term(field, _predicates(field, texts)) for field, texts in conditions if texts is not None]
        for key, value in (meta or {}).items():
            terms.append(Term("meta", _meta_text(key, value)))
        return Constraint((frozenset(terms),))


def _checked_types(args: Any) -> Sequence[Any]:
    if not isinstance(args, list | tuple):
        raise ConfigurationError(problem=f"args must be a list of types, such as [float, str], not {args!r}")
    return args  # pyright: ignore[reportUnknownVariableType]


def _predicates(field: str, texts: str | Sequence[str]) -> str:
    several = [texts] if isinstance(texts, str) else texts
    text = ", ".join(_pattern(field, pattern) for pattern in several)
    return ", ".join(map(str, parse_predicates(text)))


def _meta_text(key: str, value: Scalar) -> str:
    checked_meta({key: value})
    return msgspec.json.encode([key, value]).decode()


def checked_meta(meta: Mapping[str, Any]) -> dict[str, Scalar]:
    """Checks plain keys and values; raises ConfigurationError for anything else."""
    for key, value in meta.items():
        plain = value is None or isinstance(value, bool | int | float | str)
        whole = not isinstance(value, int) or -(2**63) <= value < 2**63
        if not isinstance(key, str) or not key or not plain or not whole:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ConfigurationError(
                problem=f"meta maps names to numbers, texts, booleans or None, not {key!r}: {value!r}"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigurationError(problem=f"meta {key!r} must be finite, not {value}")
    return dict(meta)


def _pattern(field: str, pattern: str) -> str:
    if not isinstance(pattern, str) or not pattern:  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigurationError(problem=f"{field} must be a non-empty text, not {pattern!r}")
    return pattern


where: Final = _Where()
"""``where(name=..., group=...) & ~where.local``: a condition on services."""


def service_at(text: str) -> Constraint:
    """One service by its group and name, ``rosie.head.move_to``; groups beneath the group count, too."""
    group, _, name = text.rpartition(".")
    return where(name=name, group=group or None)


def services_at(text: str) -> Constraint:
    """A group and everything beneath it, or one service by its group and name."""
    return where(group=text) | service_at(text)


def group_at(text: str) -> Constraint:
    """A group and everything beneath it."""
    return where(group=text)


def as_constraint(which: object, function: str, read: Callable[[str], Constraint]) -> Constraint:
    """A constraint as it is, and a text as ``read`` understands it.

    Args:
        which: what a caller has given.
        function: its name, for the error.
        read: `service_at`, `services_at` or `group_at`.

    Raises:
        ConfigurationError: it is neither, or a malformed text.
    """
    if isinstance(which, Constraint):
        return which
    if not isinstance(which, str):
        problem = f"say which services by where(...) or as a text such as 'rosie.head', not by {which!r}"
        raise ConfigurationError(where=function, problem=problem)
    try:
        return read(which)
    except ConfigurationError as bad:
        raise ConfigurationError(where=f"{function} {which!r}", problem=bad.problem) from None
