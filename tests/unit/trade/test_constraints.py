"""``where``: what a service must be."""

import inspect
import json
import threading
from dataclasses import dataclass, field
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade import Constraint, Container, Handle, service, where
from trade._registry.constraints import Term
from trade._services.decorator import ServiceMark
from trade._services.signature import Signature
from trade.errors import ConfigurationError
from trade.protocol.codec import Codec
from trade.protocol.messages import ServiceInfo

pytestmark = pytest.mark.virtual_time

_PLAIN = ServiceInfo(name="move", signature="move()")
_CODEC = Codec(lambda value: value, lambda code, data: data)


@dataclass(frozen=True)
class Candidate:
    name: str = "move"
    groups: tuple[str, ...] = ()
    host: str = "edge"
    container: str = "driver"
    local: bool = False
    info: ServiceInfo = _PLAIN
    kinds: tuple[str, ...] = ()
    meta: dict[str, Any] = field(default_factory=dict)
    healthy: bool = True


def using(*resources: str) -> Candidate:
    return Candidate(info=ServiceInfo(name="move", signature="move()", uses=resources))


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
    (where(uses="rosie.left"), using("rosie.left.wrist"), True),
    (where(uses="rosie.left"), using("rosie.lefty"), False),
    (where(uses="rosie.left"), using("gripper", "rosie.left"), True),
    (where(kind="Motor"), Candidate(kinds=("DynamixelMotor", "Motor")), True),
    (where(kind="*Motor"), Candidate(kinds=("DynamixelMotor",)), True),
    (where(kind="Motor"), Candidate(kinds=("Gripper",)), False),
    (where(meta={"payload_kg": 2}), Candidate(meta={"payload_kg": 2.0, "a": None}), True),
    (where(meta={"payload_kg": 2}), Candidate(meta={"payload_kg": 3}), False),
    (where(meta={"left": True}), Candidate(meta={"left": 1}), False),
    (where(meta={"a": 1, "b": "x"}), Candidate(meta={"a": 1, "b": "y"}), False),
    (where(meta={"a": None}), Candidate(), False),
    (where(meta={}), Candidate(), True),
    (where(healthy=True), Candidate(), True),
    (where(healthy=False), Candidate(), False),
    (where.healthy, Candidate(healthy=False), False),
    (~where.healthy, Candidate(healthy=False), True),
]


@pytest.mark.parametrize(("constraint", "candidate", "matches"), MATCHES, ids=lambda value: str(value)[:60])
def test_a_constraint_matches_what_it_says(constraint: Constraint, candidate: Candidate, matches: bool) -> None:
    assert constraint.matches(candidate) is matches


_dotted = st.sampled_from(["a", "b", "a.b", "a.b.c", "ab"])
_patterns = st.sampled_from(["*", "a*", "?"])
_TYPES: list[Any] = [int, float, str, bool, None, list[int], list[float], int | None, dict[str, int]]
_FACTS = ["see(cup)", "on(cup, table)", "on(cup, cup)", "at(?place)"]
_PATTERNS = ["see(?x)", "on(?x, ?x)", "on(?x, table)", "at(dock)", "?x", "see(?x), on(?x, ?y)"]


_conditions = st.sampled_from(["needs", "achieves"])


def _term(**asked: Any) -> Term:
    [[term]] = where(**asked).clauses
    return term


_terms = st.one_of(
    st.builds(Term, st.sampled_from(["name", "host", "container", "kind"]), st.one_of(_dotted, _patterns)),
    st.builds(Term, st.sampled_from(["group", "uses"]), _dotted),
    st.sampled_from([Term("local", ""), Term("healthy", "")]),
    st.builds(lambda types: _term(args=types), st.lists(st.sampled_from(_TYPES), max_size=2)),
    st.builds(lambda kind: _term(returns=kind), st.sampled_from(_TYPES)),
    st.builds(lambda field, pattern: _term(**{field: pattern}), _conditions, st.sampled_from(_PATTERNS)),
    st.builds(lambda value: _term(meta={"a": value}), st.sampled_from([1, 2, True, "x", None])),
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


def _info(
    kinds: list[Any], required: int, returns: Any, needs: list[str], achieves: list[str], uses: list[str]
) -> ServiceInfo:
    def function(*_: Any) -> Any: ...

    places = [
        inspect.Parameter(
            f"p{index}",
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            annotation=kind,
            default=inspect.Parameter.empty if index < required else None,
        )
        for index, kind in enumerate(kinds)
    ]
    function.__signature__ = inspect.Signature(places)  # type: ignore[attr-defined]
    function.__annotations__ = {**{place.name: place.annotation for place in places}, "return": returns}
    mark = ServiceMark(needs=tuple(needs), achieves=tuple(achieves), uses=tuple(uses))
    return Signature("robot.go", "go", mark, function, _CODEC).info


_infos = st.builds(
    _info,
    st.lists(st.sampled_from(_TYPES), max_size=2),
    st.integers(0, 2),
    st.sampled_from(_TYPES),
    st.lists(st.sampled_from(_FACTS), max_size=2),
    st.lists(st.sampled_from(_FACTS), max_size=2),
    st.lists(st.sampled_from(["a", "a.b", "ab"]), max_size=2),
)
_candidates = st.builds(
    Candidate,
    info=_infos,
    kinds=st.lists(st.sampled_from(["a", "b", "ab"]), max_size=2).map(tuple),
    meta=st.dictionaries(st.just("a"), st.sampled_from([1, 2, True, "x", None])),
    healthy=st.booleans(),
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


def _like(text: str, pattern: str) -> bool:
    if not pattern:
        return not text
    if pattern[0] == "*":
        return any(_like(text[at:], pattern[1:]) for at in range(len(text) + 1))
    return text != "" and pattern[0] in ("?", text[0]) and _like(text[1:], pattern[1:])


def _under(name: str, above: str) -> bool:
    words = above.split(".")
    return name.split(".")[: len(words)] == words


def _holds(term: Term, candidate: Candidate) -> bool:
    """One field at a time, as one would say it; types and post-conditions have tables of their own."""
    match term.field:
        case "name" | "host" | "container":
            return _like(getattr(candidate, term.field), term.pattern)
        case "kind":
            return any(_like(kind, term.pattern) for kind in candidate.kinds)
        case "group":
            return any(_under(group, term.pattern) for group in candidate.groups)
        case "uses":
            return any(_under(resource, term.pattern) for resource in candidate.info.uses)
        case "local":
            return candidate.local
        case "healthy":
            return candidate.healthy
        case "meta":
            key, value = json.loads(term.pattern)
            return any((key, repr(value)) == (name, repr(given)) for name, given in candidate.meta.items())
        case _:
            return term.matches(candidate)


def _evaluated(expression: Any, candidate: Candidate) -> bool:
    match expression:
        case Term():
            return _holds(expression, candidate) is not expression.negated
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
    "term",
    [
        ["args", "no types", False],
        ["args", "[1, 2]", False],
        ["returns", "[[{}, {}], {}]", False],
        ["achieves", "see(", False],
        ["needs", "see(", False],
        ["meta", "[]", False],
        ["meta", '["a", [1]]', False],
    ],
)
def test_a_term_whose_pattern_makes_no_sense_is_refused_on_arrival(term: list[Any]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.msgpack.decode(msgspec.msgpack.encode({"clauses": [[term]]}), type=Constraint)


@given(_expressions)
def test_a_constraint_can_be_kept_in_a_set_and_read(expression: Any) -> None:
    constraint = _built(expression)
    assert {constraint, _built(expression)} == {constraint}
    assert str(constraint)


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


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"args": float}, "args must be a list of types"),
        ({"args": [object]}, "this type cannot be sent"),
        ({"returns": threading.Lock}, "this type cannot be sent"),
        ({"achieves": "see(?x"}, "a closing parenthesis is missing"),
        ({"needs": "see(?x"}, "a closing parenthesis is missing"),
        ({"needs": ["at(?p)", ""]}, "needs must be a non-empty text"),
        ({"achieves": ""}, "must be a non-empty text"),
        ({"meta": {"a": [1]}}, "meta maps names to numbers"),
        ({"meta": {"a": float("nan")}}, "must be finite"),
        ({"meta": {1: 2}}, "meta maps names to numbers"),
        ({"meta": {"a": 2**70}}, "meta maps names to numbers"),
        ({"uses": ""}, "must be a non-empty text"),
        ({"kind": int}, "must be a non-empty text"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_where_it_is_written(wrong: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigurationError, match=problem):
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
    (where(args=[float, list[int], Any]), "args=[float, list[int], Any]"),
    (where(args=[], returns=None), "args=[] and returns=None"),
    (where(returns=int | None, healthy=False), "not healthy and returns=int | None"),
    (where(returns=Handle), "returns=Handle"),
    (where(achieves=["see( ?x )", "on(?x,table)"]), "achieves='see(?x), on(?x, table)'"),
    (where(needs="see( ?x )", achieves="holding(?x)"), "achieves='holding(?x)' and needs='see(?x)'"),
    (where(meta={"side": "left"}), "meta side='left'"),
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


@pytest.mark.parametrize(
    ("asked", "remedy"),
    [
        ({"group": "x*"}, "each name includes everything beneath it, as rosie does"),
        (
            {"group": "rosie.*"},
            "each name includes everything beneath it; write group='rosie'",
        ),
        ({"group": "rosie.neck.p?n"}, "write group='rosie.neck'"),
        ({"uses": "rosie.left*"}, "write uses='rosie'"),
        ({"group": "rosie."}, "is no group; use words joined by dots"),
        ({"group": "rosie head"}, "is no group; use words joined by dots"),
    ],
    ids=str,
)
def test_a_group_that_could_match_nothing_is_refused(asked: dict[str, str], remedy: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        where(**asked)
    assert remedy in str(refused.value)
