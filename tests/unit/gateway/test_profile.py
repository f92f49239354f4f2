"""What is made of noted calls: statistics, usual sequences, what deviates from them."""

from pathlib import Path
from typing import Any

import pytest

from trade import Span
from trade.call_model import deviations, learn, sequences
from trade.errors import ConfigurationError
from trade_gateway.cli.watching._profile import read, statistics, write

pytestmark = pytest.mark.virtual_time


def span(call_id: int, service: str, **others: Any) -> Span:
    given: dict[str, Any] = {
        "calls": (), "side": "served", "container": "robot", "caller": "ui", "session": "ui/1",
        "began": float(call_id), "took_s": 0.001, "outcome": "ok", **others,
    }  # fmt: skip
    return Span(call_id=call_id, service=service, **given)


def played(*services: str, first: int = 1, **others: Any) -> list[Span]:
    return [span(first + index, service, **others) for index, service in enumerate(services)]


def test_calls_and_errors_are_counted_by_service_and_times_ranked() -> None:
    spans = [span(number, "move", took_s=number / 1000) for number in range(1, 101)]
    spans += [span(200, "look", outcome="ValueError", caller="mind"), span(201, "look")]
    move, look = statistics(spans)
    assert (move.service, move.calls, move.errors) == ("move", 100, 0)
    assert (move.p50_s, move.p99_s, move.max_s) == (0.050, 0.099, 0.100)
    assert (look.calls, look.errors, look.callers) == (2, 1, ("mind", "ui"))


def test_a_call_both_sides_noted_counts_once_as_it_was_served() -> None:
    both = [span(1, "move", side="asked", took_s=0.5), span(1, "move", took_s=0.25), span(2, "move", side="asked")]
    for noted in (both, both[::-1]):
        [move] = statistics(noted)
        assert (move.calls, move.max_s) == (2, 0.25)


def test_with_one_call_every_percentile_is_that_call() -> None:
    [only] = statistics([span(1, "move", took_s=0.125)])
    assert (only.p50_s, only.p99_s, only.max_s) == (0.125, 0.125, 0.125)


def test_callers_do_not_mix_and_what_a_call_makes_is_a_sequence_of_its_own() -> None:
    spans = [
        span(1, "look"),
        span(2, "sing", session="radio/1"),
        span(3, "lock", calls=(1,), session="mind/1"),
        span(4, "move", calls=(1,), session="mind/1"),
        span(5, "look"),
        span(6, "lock", calls=(5, 99), session="mind/1"),
    ]
    found = sorted([one.service for one in calls] for calls in sequences(spans))
    assert found == [["lock"], ["lock", "move"], ["look", "look"], ["sing"]]


def test_the_order_of_calls_is_counted_and_kept(tmp_path: Path) -> None:
    model = learn(played("a", "b", "a", "b", "a", "c"))
    assert model.after == {"a": {"b": 2, "c": 1}, "b": {"a": 2}}
    write(tmp_path / "usual.json", model)
    assert read(tmp_path / "usual.json") == model


def test_usual_behaviour_shows_no_deviation() -> None:
    spans = played(*["a", "b"] * 50)
    assert deviations(spans, learn(spans)) == []


def test_a_transition_never_seen_before_is_new_with_its_call() -> None:
    usual = learn(played(*["a", "b"] * 5))
    [to, back] = deviations(played("a", "b", "x", "a"), usual)
    assert (to.kind, to.before, to.after, to.call_id, to.usual) == ("new", "b", "x", 3, 0.0)
    assert (back.before, back.after, back.call_id) == ("x", "a", 4)


def test_a_sequence_that_became_rare_is_reported_with_what_replaced_it() -> None:
    usual = learn(played(*["a", "b", "a", "c"] * 20))
    [gone] = deviations(played(*["a", "b"] * 40), usual)
    assert (gone.kind, gone.before, gone.after, gone.now) == ("rarer", "a", "c", 0.0)
    assert gone.usual == pytest.approx(0.5)
    assert gone.call_id == 80


def test_a_call_that_has_become_a_little_rarer_is_not_reported() -> None:
    usual = learn(played(*["a", "b", "a", "c"] * 20))
    assert deviations(played(*["a", "b", "a", "b", "a", "c"] * 15), usual) == []


def test_a_rarely_seen_call_that_is_missing_is_not_reported() -> None:
    usual = learn(played(*["a", "b", "a", "c"] * 20))
    assert deviations(played(*["a", "b"] * 10), usual) == []
    assert deviations(played(*["a", "b"] * 40), learn(played("a", "c", "a", "b", "a"))) == []


@pytest.mark.parametrize("text", ["", "[]", '{"v": 2, "after": {}}', '{"v": 1, "after": {"a": {"b": "often"}}}'])
def test_a_file_that_is_no_model_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "usual.json"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=r"usual\.json"):
        read(path)


def test_a_file_that_is_missing_or_cannot_be_written_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.json"):
        read(tmp_path / "none.json")
    with pytest.raises(ConfigurationError, match="folder"):
        write(tmp_path / "folder" / "usual.json", learn([]))
