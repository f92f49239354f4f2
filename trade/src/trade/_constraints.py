"""``where``: what a service must be. And, or, not, kept as disjunctive normal form; plain data that can be sent."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Final, Literal, Protocol

from msgspec import Struct

from trade.errors import ConfigurationError

__all__ = ["Candidate", "Constraint", "where"]

_MOST_CLAUSES: Final = 1000
_Field = Literal["name", "group", "host", "container", "local"]


class Candidate(Protocol):
    """What a constraint looks at."""

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


class Term(Struct, frozen=True, array_like=True, order=True):
    """One test: a field against a pattern."""

    field: _Field
    pattern: str
    negated: bool = False

    def __invert__(self) -> "Term":
        return Term(self.field, self.pattern, not self.negated)

    def matches(self, candidate: Candidate) -> bool:
        return self._holds(candidate) is not self.negated

    def _holds(self, candidate: Candidate) -> bool:
        if self.field == "local":
            return candidate.local
        if self.field == "group":
            return any(under(group, self.pattern) for group in candidate.groups)
        value: str = getattr(candidate, self.field)
        return value == self.pattern or fnmatchcase(value, self.pattern)

    def __str__(self) -> str:
        text = "local" if self.field == "local" else f"{self.field}={self.pattern!r}"
        return f"not {text}" if self.negated else text


def under(group: str, selected: str) -> bool:
    """Whether a dotted group is the selected one or beneath it; whole segments only."""
    return group == selected or group.startswith(selected + ".")


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
        """Whether a service is one of those meant."""
        return any(all(term.matches(candidate) for term in clause) for clause in self.clauses)

    def __str__(self) -> str:
        if not self.clauses:
            return "nothing"
        texts = [" and ".join(str(term) for term in sorted(clause)) or "everything" for clause in self.clauses]
        return texts[0] if len(texts) == 1 else " or ".join(f"({text})" for text in texts)


def _normal(clauses: Sequence[frozenset[Term]]) -> Constraint:
    """Without clauses that contradict themselves or say no more than another one."""
    if len(clauses) > _MOST_CLAUSES:
        raise ConfigurationError(problem=f"this constraint has more than {_MOST_CLAUSES} alternatives; make it simpler")
    sound = {clause for clause in clauses if not any(~term in clause for term in clause)}
    return Constraint(tuple(clause for clause in sorted(sound, key=sorted) if not any(c < clause for c in sound)))


class _Where:
    """Makes constraints; see ``where``."""

    local: Final = Constraint((frozenset((Term("local", ""),)),))
    """Services of this very container."""

    def __call__(
        self,
        *,
        name: str | None = None,
        group: str | None = None,
        host: str | None = None,
        container: str | None = None,
        local: bool | None = None,
    ) -> Constraint:
        """Services that fit everything said; nothing said: all.

        Args:
            name: the service's name, ``*`` and ``?`` stand for anything.
            group: a dotted group; selects everything beneath it, too.
            host: the computer's name, ``*`` and ``?`` allowed.
            container: the container's name, ``*`` and ``?`` allowed.
            local: whether it lives in this container.
        """
        given: tuple[tuple[_Field, str | None], ...]
        given = (("name", name), ("group", group), ("host", host), ("container", container))
        terms = [Term(field, _pattern(field, pattern)) for field, pattern in given if pattern is not None]
        if local is not None:
            terms.append(Term("local", "", negated=not local))
        return Constraint((frozenset(terms),))


def _pattern(field: str, pattern: str) -> str:
    if not isinstance(pattern, str) or not pattern:  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigurationError(problem=f"{field} must be a non-empty text, not {pattern!r}")
    return pattern


where: Final = _Where()
"""``where(name=..., group=...) & ~where.local``: what a service must be."""
