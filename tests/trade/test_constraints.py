"""``where``: what a service must be."""

from dataclasses import dataclass
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade import Constraint, Container, service, where
from trade._constraints import Term
from trade.errors import ConfigurationError


@dataclass(frozen=True)
class Candidate:
    name: str = "move"
    groups: tuple[str, ...] = ()
    host: str = "edge"
    container: str = "driver"
    local: bool = False


MATCHES: list[tuple[Constraint, Candidate, bool]] = [
    (where(), Candidate(), True),
    (where(name="move"), Candidate(), True),
    (where(name="mov"), Candidate(), False),
    (where(name="mo*"), Candidate(), True),
    (where(name="m?ve"), Candidate(), True),
    (where(name="*"), Candidate(name=""), True),
    (where(name="MOVE"), Candidate(), False),
    (where(name="[m]ove"), Candidate(name="[m]ove"), True),
    (where(group="rosie"), Candidate(groups=("rosie",)), True),
    (where(group="rosie"), Candidate(groups=("rosie.head.pan",)), True),
    (where(group="rosie"), Candidate(groups=("rosie2",)), False),
    (where(group="rosie"), Candidate(groups=("lab", "rosie.head")), True),
    (where(group="rosie.head"), Candidate(groups=("rosie",)), False),
    (where(group="rosie.he"), Candidate(groups=("rosie.head",)), False),
    (where(group="head"), Candidate(groups=("rosie.head",)), False),
    (where(group="rosie"), Candidate(), False),
    (where(host="edge*"), Candidate(host="edge-7"), True),
    (where(container="driver"), Candidate(), True),
    (where(container="d*r"), Candidate(), True),
    (where.local, Candidate(local=True), True),
    (where(local=True), Candidate(local=False), False),
    (where(local=False), Candidate(local=False), True),
    (~where.local, Candidate(local=False), True),
    (where(name="move", group="rosie"), Candidate(groups=("arm",)), False),
    (where(name="move") & where(group="arm"), Candidate(groups=("arm",)), True),
    (where(name="stop") | where(group="arm"), Candidate(groups=("arm",)), True),
    (where(name="stop") | where(name="halt"), Candidate(), False),
    (~where(name="stop"), Candidate(), True),
    (~(where(name="move") | where(name="stop")), Candidate(), False),
    (~(where(name="move") & where(group="x")), Candidate(), True),
    (~where(), Candidate(), False),
    (where(name="a") & ~where(name="a"), Candidate(name="a"), False),
    (where(name="a") | ~where(name="a"), Candidate(name="b"), True),
]


@pytest.mark.parametrize(("constraint", "candidate", "matches"), MATCHES, ids=lambda value: str(value)[:60])
def test_a_constraint_matches_what_it_says(constraint: Constraint, candidate: Candidate, matches: bool) -> None:
    assert constraint.matches(candidate) is matches


# --- any combination means the same as evaluating it term by term

_texts = st.sampled_from(["a", "b", "a.b", "a.b.c", "ab", "*", "a*", "?"])
_terms = st.one_of(
    st.builds(Term, st.sampled_from(["name", "group", "host", "container"]), _texts),
    st.just(Term("local", "")),
)
_expressions = st.recursive(
    _terms,
    lambda inner: st.one_of(
        st.tuples(st.just("not"), inner),
        st.tuples(st.just("and"), inner, inner),
        st.tuples(st.just("or"), inner, inner),
    ),
    max_leaves=6,
)
_candidates = st.builds(
    Candidate,
    name=st.sampled_from(["a", "b", "ab"]),
    groups=st.lists(st.sampled_from(["a", "b", "a.b", "a.b.c", "ab"]), max_size=2).map(tuple),
    host=st.sampled_from(["a", "b"]),
    container=st.sampled_from(["a", "ab"]),
    local=st.booleans(),
)


def _built(expression: Any) -> Constraint:
    match expression:
        case Term():
            return Constraint((frozenset((expression,)),))
        case ("not", inner):
            return ~_built(inner)
        case ("and", left, right):
            return _built(left) & _built(right)
        case (_, left, right):
            return _built(left) | _built(right)


def _evaluated(expression: Any, candidate: Candidate) -> bool:
    match expression:
        case Term():
            return expression.matches(candidate)
        case ("not", inner):
            return not _evaluated(inner, candidate)
        case ("and", left, right):
            return _evaluated(left, candidate) and _evaluated(right, candidate)
        case (_, left, right):
            return _evaluated(left, candidate) or _evaluated(right, candidate)


@given(_expressions, _candidates)
def test_the_normal_form_means_what_was_written(expression: Any, candidate: Candidate) -> None:
    assert _built(expression).matches(candidate) is _evaluated(expression, candidate)


@given(_expressions)
def test_a_constraint_survives_the_wire(expression: Any) -> None:
    constraint = _built(expression)
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(constraint), type=Constraint) == constraint


@given(_expressions, _expressions)
def test_the_order_of_writing_does_not_matter(left: Any, right: Any) -> None:
    one, other = _built(left), _built(right)
    assert one & other == other & one
    assert one | other == other | one


def test_a_term_about_an_unknown_field_is_refused_on_arrival() -> None:
    sent = msgspec.msgpack.encode({"clauses": [[["weight", "5", False]]]})
    with pytest.raises(msgspec.ValidationError):
        msgspec.msgpack.decode(sent, type=Constraint)


@pytest.mark.parametrize(
    "misuse",
    [
        lambda: where(name="a") and where(name="b"),
        lambda: where(name="a") or where(name="b"),
        lambda: not where(name="a"),
        lambda: bool(where.local),
    ],
)
def test_the_words_and_or_not_are_refused_instead_of_misunderstood(misuse: Any) -> None:
    with pytest.raises(TypeError, match=r"combine with & | ~ instead of and, or, not"):
        misuse()


@pytest.mark.parametrize("wrong", [{"name": ""}, {"group": 5}, {"host": b"edge"}])
def test_a_pattern_must_be_a_text(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match="must be a non-empty text"):
        where(**wrong)


def test_a_constraint_that_explodes_is_refused() -> None:
    wide = where(name="a0") & where(group="b0")
    with pytest.raises(ConfigurationError, match="more than 1000 alternatives; make it simpler"):
        for index in range(1, 20):
            wide = (wide | (where(name=f"a{index}") & where(group=f"b{index}"))) & (
                where(host=f"h{index}") | where(container=f"c{index}")
            )


TEXTS = [
    (where(), "everything"),
    (~where(), "nothing"),
    (where(name="a", group="b"), "group='b' and name='a'"),
    (where(name="a") | ~where.local, "(not local) or (name='a')"),
]


@pytest.mark.parametrize(("constraint", "text"), TEXTS, ids=[text for _, text in TEXTS])
def test_a_constraint_reads_like_a_sentence(constraint: Constraint, text: str) -> None:
    assert str(constraint) == text


def test_host_container_and_local_select_in_a_system(here: Container, there: Container) -> None:
    class One:
        @service
        def go(self) -> None: ...

    here.register(One(), "a")
    there.register(One(), "a")
    remote = here.find(where(name="go") & ~where.local, wait_s=20)
    assert remote.container == "there"
    assert here.find(where(name="go", local=True)).container == "here"
    assert here.find(where(name="go", container="th*")) == remote
    assert len(here.services(where(name="go", host=remote.host))) == 2
    assert here.services(where(name="go", host="elsewhere")) == []
