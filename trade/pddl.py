"""Services as a planning domain in PDDL: each service with post-conditions is an action."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, Generic, NamedTuple, TypeVar

from trade._calls.handle import Handle
from trade._registry.predicates import Predicate, parse_condition
from trade.errors import ConfigurationError

_WORDS: Final[frozenset[str]] = frozenset(
    re.findall(
        r"\S+",
        "all always and assign at-end at-start decrease define domain either exists forall imply increase not number "
        "object or over problem scale-down scale-up total-cost total-time when",
    )
)
"""Words that PDDL or its usual extensions reserve."""


class PddlDomain(NamedTuple):
    """A domain, and the services that PDDL cannot express."""

    text: str
    left_out: dict[str, str]
    """From the label of a service to the reason."""


class _Action(NamedTuple):
    handle: Handle
    needs: list[Predicate]
    achieves: list[Predicate]

    @property
    def conditions(self) -> list[Predicate]:
        return [*self.needs, *self.achieves]


def pddl_domain(services: Iterable[Handle], name: str = "trade") -> str:
    """The pre-conditions and post-conditions of services as a domain for planners, in PDDL.

    Services without post-conditions are left out. A condition ``not(p)`` is PDDL's ``(not (p))``. Names that PDDL does
    not allow are changed; a comment lists them. A comment also names each service that PDDL cannot express: one with a
    malformed condition, or with a variable inside a term, as in ``at(pose(?x))``.

    Args:
        services: such as ``trade.services("rosie")``.
        name: the name of the domain.

    Returns:
        The text of a domain file; the same for the same services. It requires ``:strips``, and
        ``:negative-preconditions`` if a service needs that a condition does not hold.
    """
    return domain_of(services, name).text


def domain_of(services: Iterable[Handle], name: str) -> PddlDomain:
    """What `pddl_domain` returns, and the services that it leaves out."""
    actions: list[_Action] = []
    left_out: dict[str, str] = {}
    for handle in sorted(services, key=lambda handle: (handle.label, handle.container, handle.key.provider)):
        if handle.achieves:
            try:
                actions.append(_Action(handle, _atoms(handle.needs), _atoms(handle.achieves)))
            except ConfigurationError as bad:
                left_out[handle.label] = bad.problem
    return PddlDomain(_Writer(actions).text(name, left_out), left_out)


def _atoms(conditions: Sequence[str]) -> list[Predicate]:
    read = [parse_condition(text) for text in conditions]
    for condition in read:
        atom = _positive(condition)
        if atom.is_variable or _is_negated(atom):
            raise ConfigurationError(problem=f"{condition}: not() takes one predicate that is neither ?x nor not()")
        if open_terms := [term for term in atom.arguments if term.arguments and _has_variable(term)]:
            raise ConfigurationError(problem=f"{condition}: PDDL has no term with a variable inside: {open_terms[0]}")
    return read


def _has_variable(term: Predicate) -> bool:
    return term.is_variable or any(map(_has_variable, term.arguments))


def _is_negated(condition: Predicate) -> bool:
    return condition.functor == "not" and len(condition.arguments) == 1


def _positive(condition: Predicate) -> Predicate:
    return condition.arguments[0] if _is_negated(condition) else condition


_Key = TypeVar("_Key", str, int, tuple[str, int])


class _Names(Generic[_Key]):
    """A name in PDDL for each text: different keys have names that differ by more than the case of letters."""

    def __init__(self, texts: Mapping[_Key, str]) -> None:
        self._texts = texts
        self._names: dict[_Key, str] = {}
        taken: set[str] = set(_WORDS)
        for key, text in sorted(texts.items(), key=lambda item: (_allowed(item[1]) != item[1], item[1], item[0])):
            name, number = _allowed(text), 2
            while name in taken:
                name, number = f"{_allowed(text)}-{number}", number + 1
            taken.add(name)
            self._names[key] = name

    def __getitem__(self, key: _Key) -> str:
        return self._names[key]

    def __iter__(self) -> Iterator[_Key]:
        return iter(self._names)

    def all(self) -> list[str]:
        return sorted(self._names.values())

    def changed(self) -> list[str]:
        """A comment for each text that has another name."""
        return sorted(
            f"; {name} is {self._texts[key]}" for key, name in self._names.items() if name != self._texts[key]
        )


def _allowed(text: str) -> str:
    name = re.sub(r"[^a-z0-9_]+", "-", text.lower()).strip("-")
    return name if name[:1].isalpha() else f"x-{name}".rstrip("-")


def _line(text: str) -> str:
    """A text of another container in one line."""
    return "".join(one if one.isprintable() else " " for one in text)


def _list(*parts: str) -> str:
    return f"({' '.join(parts)})"


class _Writer:
    def __init__(self, actions: Sequence[_Action]) -> None:
        self._actions = actions
        atoms = [_positive(one) for action in actions for one in action.conditions]
        self._predicates = _Names({_place(atom): atom.functor for atom in atoms})
        terms = [str(term) for atom in atoms for term in atom.arguments if not term.is_variable]
        self._constants = _Names({term: term for term in terms})
        self._labels = _Names({number: action.handle.label for number, action in enumerate(actions)})

    def text(self, name: str, left_out: Mapping[str, str]) -> str:
        negative = any(_is_negated(need) for action in self._actions for need in action.needs)
        lines = [
            "; Services of a TRADE system as actions, by their pre-conditions and post-conditions.",
            *self._predicates.changed(),
            *self._constants.changed(),
            *(f"; left out: {_line(label)}: {_line(reason)}" for label, reason in left_out.items()),
            f"(define (domain {_Names({name: name})[name]})",
            f"  (:requirements :strips{' :negative-preconditions' if negative else ''})",
        ]
        if constants := self._constants.all():
            lines.append(f"  {_list(':constants', *constants)}")
        lines.append(f"  {_list(':predicates', *self._declared())}")
        for number, action in enumerate(self._actions):
            lines += self._action(action, self._labels[number])
        return "\n".join([*lines, ")", ""])

    def _declared(self) -> list[str]:
        places = [(self._predicates[place], place[1]) for place in self._predicates]
        return sorted(_list(name, *(f"?x{number}" for number in range(arity))) for name, arity in places)

    def _action(self, action: _Action, name: str) -> list[str]:
        terms = [term.functor for one in action.conditions for term in _positive(one).arguments if term.is_variable]
        variables = _Names({term: term for term in terms})
        return [
            "",
            f"  ; {_line(action.handle.label)} in container {_line(action.handle.container)}",
            f"  (:action {name}",
            f"    :parameters {_list(*(f'?{variables[term]}' for term in dict.fromkeys(terms)))}",
            f"    :precondition {self._all(action.needs, variables)}",
            f"    :effect {self._all(action.achieves, variables)})",
        ]

    def _all(self, conditions: Sequence[Predicate], variables: _Names[str]) -> str:
        return _list("and", *(self._condition(one, variables) for one in conditions))

    def _condition(self, condition: Predicate, variables: _Names[str]) -> str:
        atom = _positive(condition)
        terms = [
            f"?{variables[term.functor]}" if term.is_variable else self._constants[str(term)] for term in atom.arguments
        ]
        text = _list(self._predicates[_place(atom)], *terms)
        return _list("not", text) if _is_negated(condition) else text


def _place(atom: Predicate) -> tuple[str, int]:
    return atom.functor, len(atom.arguments)
