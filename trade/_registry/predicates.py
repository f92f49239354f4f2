"""Predicates such as ``on(cup, table)``: conditions of services, and patterns with variables that match them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Final

from msgspec import Struct

from trade.errors import ConfigurationError

_TOKEN: Final = re.compile(r"\s*([?]?[\w.+-]+|[(),])\s*")
_LONGEST: Final = 1000
_DEEPEST: Final = 20
_MOST_STEPS: Final = 10_000
"""The limit of steps of a match: both sides may be written so that matching would not end."""
_Bindings = Mapping[str, "Predicate"]


class Predicate(Struct, frozen=True):
    """A name with arguments, or a variable: a name that begins with ``?``."""

    functor: str
    arguments: tuple["Predicate", ...] = ()

    @property
    def is_variable(self) -> bool:
        return self.functor.startswith("?")

    def __str__(self) -> str:
        inner = ", ".join(map(str, self.arguments))
        return f"{self.functor}({inner})" if inner else self.functor


@lru_cache(4096)
def parse_predicates(text: str) -> tuple[Predicate, ...]:
    """One predicate or several between commas; raises ConfigurationError with the position of an error."""
    return _Parser(text).read()


def parse_condition(text: str, kind: str = "condition") -> Predicate:
    """A condition of a service: one predicate, and not only a variable.

    Args:
        text: the predicate.
        kind: ``pre-condition`` or ``post-condition``, for the error.

    Raises:
        ConfigurationError: it is anything else.
    """
    several = parse_predicates(text) if isinstance(text, str) else ()  # pyright: ignore[reportUnnecessaryIsInstance]
    if len(several) != 1 or several[0].is_variable:
        raise ConfigurationError(problem=f"{text!r} is no {kind}; write one predicate, such as open(gripper)")
    return several[0]


@lru_cache(4096)
def read_condition(text: str) -> Predicate | None:
    """A condition from another container; None for an invalid one."""
    try:
        return _renamed(parse_condition(text))
    except ConfigurationError:
        return None


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens: list[str] = []
        self._position = 0

    def read(self) -> tuple[Predicate, ...]:
        self._split()
        found = self._predicates(0)
        if self._position < len(self._tokens):
            raise self._syntax_error(f"{self._tokens[self._position]!r} is not expected there")
        return found

    def _split(self) -> None:
        end = 0
        while end < len(self._text) <= _LONGEST:
            token = _TOKEN.match(self._text, end)
            if token is None:
                raise self._syntax_error(f"{self._text[end]!r} is not allowed there")
            self._tokens.append(token[1])
            end = token.end()
        if len(self._text) > _LONGEST:
            raise ConfigurationError(problem=f"a predicate has at most {_LONGEST} characters, not {len(self._text)}")

    def _predicates(self, depth: int) -> tuple[Predicate, ...]:
        found = [self._predicate(depth)]
        while self._accept(","):
            found.append(self._predicate(depth))
        return tuple(found)

    def _predicate(self, depth: int) -> Predicate:
        if depth > _DEEPEST:
            raise self._syntax_error(f"it is nested deeper than {_DEEPEST}")
        name = self._tokens[self._position] if self._position < len(self._tokens) else ""
        if name in ("", "(", ")", ","):
            raise self._syntax_error("a name is missing")
        self._position += 1
        if not self._accept("("):
            return Predicate(name)
        if name.startswith("?"):
            raise self._syntax_error("a variable has no arguments")
        if self._accept(")"):
            return Predicate(name)
        arguments = self._predicates(depth + 1)
        if not self._accept(")"):
            raise self._syntax_error("a closing parenthesis is missing")
        return Predicate(name, arguments)

    def _accept(self, token: str) -> bool:
        there = self._position < len(self._tokens) and self._tokens[self._position] == token
        self._position += there
        return there

    def _syntax_error(self, problem: str) -> ConfigurationError:
        return ConfigurationError(
            problem=f"{self._text!r} is no predicate: {problem}; write it like see(?x) or on(cup, table)"
        )


def _renamed(predicate: Predicate) -> Predicate:
    """The predicate with variables that no pattern can have: one side's ``?x`` is not the other's."""
    if predicate.is_variable:
        return Predicate("?:" + predicate.functor[1:])
    return Predicate(predicate.functor, tuple(map(_renamed, predicate.arguments)))


def fits_all(conditions: Sequence[str], patterns: Sequence[Predicate]) -> bool:
    """Whether every pattern fits one of the conditions, where a variable has one meaning throughout.

    A search that takes too long counts as no match.
    """
    facts = [fact for fact in map(read_condition, conditions) if fact is not None]
    try:
        return any(True for _ in _solutions(facts, patterns, {}, iter(range(_MOST_STEPS))))
    except _TooLong:
        return False


class _TooLong(Exception):
    """A search has used all its steps."""


def _step(steps: Iterator[int]) -> None:
    if next(steps, None) is None:
        raise _TooLong


def _solutions(
    facts: Sequence[Predicate], patterns: Sequence[Predicate], bindings: _Bindings, steps: Iterator[int]
) -> Iterator[_Bindings]:
    if not patterns:
        yield bindings
        return
    for fact in facts:
        agreed = _unified(patterns[0], fact, bindings, steps)
        if agreed is not None:
            yield from _solutions(facts, patterns[1:], agreed, steps)


def _unified(left: Predicate, right: Predicate, bindings: _Bindings, steps: Iterator[int]) -> _Bindings | None:
    _step(steps)
    left, right = _walked(left, bindings), _walked(right, bindings)
    if left == right:
        return bindings
    if left.is_variable:
        return None if _occurs(left, right, bindings, steps) else {**bindings, left.functor: right}
    if right.is_variable:
        return _unified(right, left, bindings, steps)
    if left.functor != right.functor or len(left.arguments) != len(right.arguments):
        return None
    agreed: _Bindings | None = bindings
    for one, other in zip(left.arguments, right.arguments, strict=True):
        if agreed is not None:
            agreed = _unified(one, other, agreed, steps)
    return agreed


def _walked(term: Predicate, bindings: _Bindings) -> Predicate:
    while term.is_variable and term.functor in bindings:
        term = bindings[term.functor]
    return term


def _occurs(variable: Predicate, term: Predicate, bindings: _Bindings, steps: Iterator[int]) -> bool:
    _step(steps)
    term = _walked(term, bindings)
    return term == variable or any(_occurs(variable, inner, bindings, steps) for inner in term.arguments)
