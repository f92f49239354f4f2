"""An index of services by the fields that constraints use most, so that a lookup need not test them all."""

from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

from trade._protocol.keys import ServiceKey
from trade._registry.constraints import Candidate, Constraint, Term, is_exact
from trade._registry.predicates import parse_predicates, read_achieved

_Slot = tuple[str, str]
"""A field and one value of it."""


class _Keyed(Candidate, Protocol):
    @property
    def key(self) -> ServiceKey: ...


_Entry = TypeVar("_Entry", bound=_Keyed)


class Index(Generic[_Entry]):
    """Changed by one thread at a time, read by any: an entry that keeps its key is never missing meanwhile."""

    def __init__(self) -> None:
        self._all: dict[ServiceKey, _Entry] = {}
        self._slots: dict[_Slot, dict[ServiceKey, _Entry]] = {}

    def get(self, key: ServiceKey) -> _Entry | None:
        return self._all.get(key)

    def put(self, entry: _Entry) -> None:
        """Add an entry, or replace the one with the same key."""
        old = self._all.get(entry.key)
        self._all[entry.key] = entry
        slots = set(_slots_of(entry))
        for slot in slots:
            self._slots.setdefault(slot, {})[entry.key] = entry
        if old is not None:
            self._clear(old.key, set(_slots_of(old)) - slots)

    def remove(self, key: ServiceKey) -> None:
        old = self._all.pop(key, None)
        if old is not None:
            self._clear(key, set(_slots_of(old)))

    def _clear(self, key: ServiceKey, slots: set[_Slot]) -> None:
        for slot in slots:
            bucket = self._slots.get(slot, {})
            bucket.pop(key, None)
            if not bucket:
                self._slots.pop(slot, None)

    def candidates(self, constraint: Constraint) -> list[_Entry]:
        """All entries that the constraint may match and as few others as possible, each once."""
        if len(constraint.clauses) == 1:
            return self._of(constraint.clauses[0])
        found: dict[ServiceKey, _Entry] = {}
        for clause in constraint.clauses:
            found.update((entry.key, entry) for entry in self._of(clause))
        return list(found.values())

    def _of(self, clause: frozenset[Term]) -> list[_Entry]:
        """The entries in every slot that the clause requires, found from the smallest slot."""
        buckets = [self._slots.get(slot, {}) for term in clause if not term.negated for slot in _slots_asked(term)]
        if not buckets:
            return list(self._all.values())
        rarest, *others = sorted(buckets, key=len)
        entries = list(rarest.values())
        for other in others:
            entries = [entry for entry in entries if entry.key in other]
        return entries


def _slots_of(entry: Candidate) -> Iterator[_Slot]:
    yield "name", entry.name
    yield "container", entry.container
    for field, values in (("group", entry.groups), ("uses", entry.info.uses)):
        for value in values:
            for end, sign in enumerate(value):
                if sign == ".":
                    yield field, value[:end]
            yield field, value
    for kind in entry.kinds:
        yield "kind", kind
    for fact in map(read_achieved, entry.info.achieves):
        if fact is not None:
            yield "achieves", fact.functor


def _slots_asked(term: Term) -> Iterator[_Slot]:
    """The slots of which one must contain everything that the term matches; empty if there is no such slot."""
    match term.field:
        case "group" | "uses":
            yield term.field, term.pattern
        case "name" | "container" | "kind" if is_exact(term.pattern):
            yield term.field, term.pattern
        case "achieves":
            for predicate in parse_predicates(term.pattern):
                if not predicate.is_variable:
                    yield "achieves", predicate.functor
        case _:
            pass
