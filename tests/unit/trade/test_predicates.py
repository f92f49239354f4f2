"""Pre-conditions and post-conditions, and patterns with variables."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade import service
from trade._registry.predicates import Predicate, fits_all, parse_condition, parse_predicates, read_condition
from trade.errors import ConfigurationError

FITS = [
    ("see(?x)", ["see(object)"], True),
    ("see(?x)", ["hear(object)"], False),
    ("see(?x)", ["see(a, b)"], False),
    ("see(cup)", ["see(object)"], False),
    ("see(cup)", ["hear(cup)", "see(cup)"], True),
    ("connects(?x, ?x)", ["connects(a, b)"], False),
    ("connects(?x, ?x)", ["connects(a, a)"], True),
    ("connects(?x, ?y)", ["connects(a, a)"], True),
    ("at(pose(?x, ?y), ?x)", ["at(pose(1, 2), 1)"], True),
    ("at(pose(?x, ?y), ?x)", ["at(pose(1, 2), 2)"], False),
    ("at(?p)", ["at(pose(1, 2))"], True),
    ("connects(?x, ?x)", ["connects(f(a), f(a))"], True),
    ("done", ["done"], True),
    ("done()", ["done"], True),
    ("?x", ["done"], True),
    ("?x", [], False),
    ("see(mug)", ["see(?anything)"], True),
    ("connects(?x, f(?x))", ["connects(?y, ?y)"], False),
    ("see(?x)", ["see(?x)"], True),
    ("connects(a, b)", ["connects(?x, ?x)"], False),
    ("see(?x), hold(?x)", ["see(cup)", "see(mug)", "hold(mug)"], True),
    ("see(?x), hold(?x)", ["see(cup)", "hold(mug)"], False),
    ("see(?x)", ["see(((", "?x", "see(cup)"], True),
    ("see(?x)", ["see(((", "?x", ""], False),
]


@pytest.mark.parametrize(("pattern", "achieved", "fits"), FITS)
def test_a_pattern_fits_what_it_says(pattern: str, achieved: list[str], fits: bool) -> None:
    assert fits_all(achieved, parse_predicates(pattern)) is fits


@pytest.mark.parametrize(
    "wrong", ["", "(", "see(", "see(a", "see(a,)", "see(a))", "?x(a)", "a b", "see(a;b)", ",", "a,"]
)
def test_what_is_no_predicate_is_refused_with_an_example(wrong: str) -> None:
    with pytest.raises(ConfigurationError, match=r"is no predicate: .*; write it like see\(\?x\)"):
        parse_predicates(wrong)


def test_predicates_have_an_end() -> None:
    with pytest.raises(ConfigurationError, match="nested deeper"):
        parse_predicates("f(" * 50 + "a" + ")" * 50)
    with pytest.raises(ConfigurationError, match="at most 1000 characters"):
        parse_predicates("a" * 1001)


@pytest.mark.parametrize("wrong", ["open(", "?x", "a, b", "", 5, None])
@pytest.mark.parametrize(("field", "kind"), [("needs", "pre-condition"), ("achieves", "post-condition")])
def test_a_malformed_condition_is_refused_where_it_is_declared(field: Any, kind: str, wrong: Any) -> None:
    with pytest.raises(ConfigurationError, match=f"is no ({kind}|predicate)"):
        service(**{field: [wrong]})


_names = st.sampled_from(["a", "b", "f", "see", "1.5", "x-y"])
_predicates = st.recursive(
    st.builds(Predicate, _names | st.sampled_from(["?x", "?y"])),
    lambda inner: st.builds(Predicate, _names, st.lists(inner, min_size=1, max_size=3).map(tuple)),
    max_leaves=8,
)


@given(_predicates)
def test_a_predicate_reads_as_it_is_written(predicate: Predicate) -> None:
    assert parse_predicates(str(predicate)) == (predicate,)


@given(_predicates.filter(lambda predicate: not predicate.is_variable))
def test_every_post_condition_is_found_by_itself(predicate: Predicate) -> None:
    assert parse_condition(str(predicate)) == predicate
    assert fits_all([str(predicate)], [predicate])


@given(st.text(alphabet="ab?x(), ", max_size=30))
def test_any_text_is_either_read_or_refused(text: str) -> None:
    read_condition(text)
    try:
        parse_predicates(text)
    except ConfigurationError as refused:
        assert repr(text) in str(refused)


def test_an_endless_search_pattern_ends_without_a_match() -> None:
    facts = [f"p({number})" for number in range(10)]
    patterns = parse_predicates(", ".join(f"p(?a{number})" for number in range(60)) + ", q(?z)")
    assert not fits_all(facts, patterns)
    assert fits_all([*facts, "q(1)"], patterns)
