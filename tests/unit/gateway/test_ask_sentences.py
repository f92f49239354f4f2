"""Two hundred sentences of operators: what each of them means, and that none is mistaken for another order."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from trade.toml_files import read_toml_text
from trade_gateway.language import NotUnderstood, read_lexicon
from trade_gateway.language._catalogue import REQUESTS

SENTENCES = Path(__file__).parent / "sentences"
LEAST = 0.9


def sentences(name: str) -> list[Mapping[str, Any]]:
    return read_toml_text((SENTENCES / name).read_text(encoding="utf-8"))["sentence"]


@pytest.mark.parametrize(("name", "count"), [("seen.toml", 146), ("unseen.toml", 60)])
def test_sentences_of_operators_mean_what_they_say_and_no_order_is_one_that_was_not_meant(
    name: str, count: int
) -> None:
    lexicon, wrong, actions = read_lexicon(), list[str](), list[str]()
    for one in sentences(name):
        expected = (one["means"], one.get("gaps", {}))
        try:
            heard = lexicon.hear(one["say"])
            understood = (heard.phrase.means, dict(heard.gaps))
        except NotUnderstood:
            understood = ("", {})
        if understood != expected:
            wrong.append(f"{one['say']!r} is {understood}")
            actions += wrong[-1:] if understood[0] and REQUESTS[understood[0]].is_order else []
    assert actions == []
    assert len(sentences(name)) == count
    assert len(wrong) <= count * (1 - LEAST), wrong


def test_the_sentences_are_about_every_request_and_no_sentence_is_in_both_files() -> None:
    seen, unseen = sentences("seen.toml"), sentences("unseen.toml")
    assert {one["means"] for one in [*seen, *unseen]} == {*REQUESTS, ""}
    for one in unseen:
        if one["means"] == "":
            assert one not in seen
