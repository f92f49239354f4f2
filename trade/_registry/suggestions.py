"""Errors of lookups with no match or too many: they suggest similar services and show how matches differ."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Final

from trade._registry.constraints import Constraint
from trade._registry.registry import Record
from trade.errors import NoSuchService, TooManyServices
from trade.protocol.keys import DOMAIN

_LIKE: Final = 0.7
_NAME_LIKE: Final = 0.6
_MOST: Final = 2
_MOST_GROUPS: Final = 20


def no_such_service(
    constraint: Constraint,
    records: Iterable[Record],
    waited_s: float,
    apart: Sequence[str] = (),
    hidden: str = "",
    beyond: Sequence[str] = (),
) -> NoSuchService:
    """The error of a lookup without a match.

    Args:
        constraint: the constraint of the lookup.
        records: all services that exist.
        waited_s: how long the lookup waited, in seconds.
        apart: missing links, and the reasons (`Reachability`).
        hidden: why the policy hides the service.
        beyond: what other containers see.
    """
    known = list(records)
    groups = sorted({group for record in known for group in record.groups} - {DOMAIN})
    near = _near(asked_for(constraint, "group"), asked_for(constraint, "name"), groups, known)
    return NoSuchService(
        constraint=str(constraint),
        waited_s=waited_s,
        near=near,
        groups=groups[:_MOST_GROUPS],
        apart=apart,
        hidden=hidden,
        beyond=beyond,
    )


def asked_for(constraint: Constraint, field: str) -> str:
    """The first pattern that a constraint has for a field; empty if it has none."""
    terms = [term for clause in constraint.clauses for term in clause if not term.negated]
    return next((term.pattern for term in terms if term.field == field), "")


def _near(group: str, name: str, groups: Sequence[str], records: Sequence[Record]) -> tuple[str, ...]:
    """Similar services. A stop is never suggested if any other service is similar."""
    if not name:
        return tuple(difflib.get_close_matches(group, groups, n=_MOST, cutoff=_LIKE))
    names = set(difflib.get_close_matches(name, sorted({record.name for record in records}), n=20, cutoff=_NAME_LIKE))
    alike = [record for record in records if record.name in names]
    asked = f"{group}.{name}" if group else name
    for stops in (False, True):
        labels = {
            record.label if group else record.name: record.label
            for record in alike
            if (record.info.effect == "stop") is stops
        }
        if close := difflib.get_close_matches(asked, sorted(labels), n=_MOST, cutoff=_LIKE if group else _NAME_LIKE):
            return tuple(labels[text] for text in close)
    return ()


def too_many_services(constraint: Constraint, matches: Sequence[Record]) -> TooManyServices:
    """The error of a lookup with several matches: each is named so that it differs from the others."""
    texts = [f"{record.label} in {record.container}" for record in matches]
    if len(set(texts)) < len(texts):
        texts = [f"{record.label} of {record.key.provider} in {record.container}" for record in matches]
    if len(set(texts)) < len(texts):  # two containers of one name
        texts = [f"{record.label} of {record.key.provider} in {record.key.address}" for record in matches]
    aspects = {
        "name": [record.name for record in matches],
        "group": [record.groups for record in matches],
        "container": [record.container for record in matches],
        "host": [record.host for record in matches],
        "kind": [record.kind for record in matches],
    }
    differing = [name for name, values in aspects.items() if len(set(values)) > 1]
    return TooManyServices(constraint=str(constraint), matches=texts, differ=differing)
