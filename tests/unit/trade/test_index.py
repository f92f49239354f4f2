"""One among ten thousand services is found without looking at all of them."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade import Constraint, where
from trade._registry.constraints import Term
from trade._registry.index import Index
from trade._registry.registry import Record, Registry
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import HEALTHY, ProviderInfo, ServiceInfo


def record(number: int, **reported: Any) -> Record:
    address = Address("me", reported.get("container", "driver"), "e1")
    name = reported.get("name", f"s{number}")
    needs, achieves, uses = (tuple(reported.get(field, ())) for field in ("needs", "achieves", "uses"))
    return Record(
        key=ServiceKey(address, "_", f"Arm-{number}", name),
        info=ServiceInfo(name=name, signature=f"{name}()", needs=needs, achieves=achieves, uses=uses),
        groups=tuple(reported.get("groups", ())),
        kind="Arm",
        host="edge",
        pid=1,
        local=False,
        kinds=tuple(reported.get("kinds", ("Arm",))),
        meta={},
        health=reported.get("health", HEALTHY),
        members={},
    )


_labels = st.lists(st.sampled_from(["a", "b", "a.b", "a.b.c", "ab"]), max_size=2)
_conditions = st.lists(st.sampled_from(["see(cup)", "see(?x)", "on(cup, table)", "?x", "(("]), max_size=2)
_reported = st.fixed_dictionaries(
    {
        "name": st.sampled_from(["a", "b", "a*"]),
        "container": st.sampled_from(["a", "b"]),
        "groups": _labels,
        "uses": _labels,
        "kinds": _labels,
        "needs": _conditions,
        "achieves": _conditions,
        "health": st.sampled_from([HEALTHY, "hot"]),
    }
)
_ATOMS = [
    *(where(**{field: text}) for field in ("name", "container", "group", "uses", "kind") for text in ("a", "a.b")),
    *(where(**{field: "a*"}) for field in ("name", "container", "kind")),
    *(
        where(**{field: text})
        for field in ("needs", "achieves")
        for text in ("see(?x)", "?x", "on(?x, ?y), see(?x)", "none(a)")
    ),
    *(where(), ~where(), where(healthy=True), where(host="edge")),
]
_constraints = st.recursive(
    st.sampled_from(_ATOMS),
    lambda inner: st.one_of(
        inner.map(lambda one: ~one),
        st.tuples(inner, inner).map(lambda both: both[0] & both[1]),
        st.tuples(inner, inner).map(lambda both: both[0] | both[1]),
    ),
    max_leaves=5,
)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 5), _reported), max_size=20), _constraints)
def test_the_index_finds_what_looking_at_all_finds(events: list[tuple[bool, int, Any]], constraint: Constraint) -> None:
    index: Index[Record] = Index()
    everything: dict[ServiceKey, Record] = {}
    for comes, number, reported in events:
        entry = record(number, **{**reported, "name": "a", "container": "a"} if number < 3 else reported)
        if comes:
            index.put(entry)
            everything[entry.key] = entry
        else:
            index.remove(entry.key)
            everything.pop(entry.key, None)
    scanned = {key for key, entry in everything.items() if constraint.matches(entry)}
    candidates = index.candidates(constraint)
    assert {entry.key for entry in candidates if constraint.matches(entry)} == scanned
    assert len(candidates) == len({entry.key for entry in candidates}) <= len(everything)
    assert all(everything[entry.key] == entry for entry in candidates)


@pytest.fixture(scope="module")
def many() -> Index[Record]:
    index: Index[Record] = Index()
    for number in range(10_000):
        index.put(
            record(
                number,
                name=f"s{number % 100}",
                groups=[f"r{number % 50}.arm.j{number}"],
                needs=[f"ready{number % 1000}(it)"],
                achieves=[f"done{number % 1000}(it)"],
                uses=[f"r{number % 50}.joint"],
            )
        )
    return index


LOOKED_AT = [
    (where(group="r7.arm.j7"), 1),
    (where(group="r7"), 200),
    (where(name="s5"), 100),
    (where(name="s7", group="r7"), 100),
    (where(name="s5", group="r9"), 0),
    (where(name="s5", achieves="done5(?x)"), 10),
    (where(needs="ready5(?x)"), 10),
    (where(needs="done5(?x)"), 0),
    (where(uses="r3"), 200),
    (where(name="s1") | where(name="s2"), 200),
    (where(name="s1") & ~where(group="r3"), 100),
    (where(name="missing"), 0),
    (where(group="r7") & ~where.local, 200),
    (where(name="s*"), 10_000),
    (~where(name="s1"), 10_000),
]


@pytest.mark.parametrize(("constraint", "count"), LOOKED_AT, ids=str)
def test_only_what_has_all_that_is_asked_is_looked_at(many: Index[Record], constraint: Constraint, count: int) -> None:
    assert len(many.candidates(constraint)) == count


def test_a_service_by_name_and_group_is_found_by_one_lookup(monkeypatch: pytest.MonkeyPatch) -> None:
    address = Address("me", "driver", "e1")
    registry = Registry(address)
    services = tuple(ServiceInfo(name=f"move_{number}", signature="()") for number in range(10))
    for number in range(200):
        info = ProviderInfo(revision=1, groups=(f"r.p{number}",), kind="Arm", host="edge", pid=1, services=services)
        registry.put(address, "r", f"Arm-{number}", info)
    asked: list[str] = []
    matches = Term.matches
    monkeypatch.setattr(Term, "matches", lambda term, entry: asked.append(entry.label) or matches(term, entry))
    for number in range(200):
        [found] = registry.select(where(name="move_7", group=f"r.p{number}"))
        assert asked == [found.label] * 2 == [f"r.p{number}.move_7"] * 2
        asked.clear()


def test_removed_services_leave_nothing_in_the_index() -> None:
    index: Index[Record] = Index()
    entry = record(1, groups=["a.b"], uses=["c.d"], needs=["at(y)"], achieves=["see(x)"])
    index.put(entry)
    index.put(record(1, groups=["z"]))
    index.remove(entry.key)
    assert (index._all, index._slots) == ({}, {})
