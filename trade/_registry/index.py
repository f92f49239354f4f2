"""An index of services by the fields that constraints use most, so that a lookup need not test them all."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Generic, Protocol, TypeVar

from trade._registry.constraints import Candidate, Constraint, Term, is_exact
from trade._registry.predicates import parse_predicates, read_condition
from trade.protocol.keys import ServiceKey

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
        slots = _slots_of(entry)
        for slot in slots:
            self._slots.setdefault(slot, {})[entry.key] = entry
        if old is not None:
            self._clear(old.key, _slots_of(old) - slots)

    def remove(self, key: ServiceKey) -> None:
        old = self._all.pop(key, None)
        if old is not None:
            self._clear(key, _slots_of(old))

    def _clear(self, key: ServiceKey, slots: frozenset[_Slot]) -> None:
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


def _slots_of(entry: Candidate) -> frozenset[_Slot]:
    info = entry.info
    shared = _slots_of_provider(entry.container, tuple(entry.groups), tuple(entry.kinds))
    return shared | _slots_of_service(entry.name, info.uses, info.needs, info.achieves)


@lru_cache(maxsize=1024)
def _slots_of_provider(container: str, groups: tuple[str, ...], kinds: tuple[str, ...]) -> frozenset[_Slot]:
    """Those of all services of a provider: many follow each other when a container joins."""
    return frozenset((("container", container), *_prefixes("group", groups), *(("kind", kind) for kind in kinds)))


@lru_cache(maxsize=4096)
def _slots_of_service(
    name: str, uses: tuple[str, ...], needs: tuple[str, ...], achieves: tuple[str, ...]
) -> frozenset[_Slot]:
    """Those of a service: most containers offer the same ones."""
    slots: set[_Slot] = {("name", name), *_prefixes("uses", uses)}
    for field, conditions in (("needs", needs), ("achieves", achieves)):
        slots.update((field, fact.functor) for fact in map(read_condition, conditions) if fact is not None)
    return frozenset(slots)


def _prefixes(field: str, values: tuple[str, ...]) -> Iterator[_Slot]:
    for value in values:
        for end, sign in enumerate(value):
            if sign == ".":
                yield field, value[:end]
        yield field, value


def _slots_asked(term: Term) -> Iterator[_Slot]:
    """The slots of which one must contain everything that the term matches; empty if there is no such slot."""
    match term.field:
        case "group" | "uses":
            yield term.field, term.pattern
        case "name" | "container" | "kind" if is_exact(term.pattern):
            yield term.field, term.pattern
        case "needs" | "achieves":
            for predicate in parse_predicates(term.pattern):
                if not predicate.is_variable:
                    yield term.field, predicate.functor
        case _:
            pass
