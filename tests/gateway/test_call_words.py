"""The words of ``trade call``: JSON, by place or by name, and what was probably meant by others."""

import pytest

from trade_gateway.commands._call import parse_arguments
from trade_gateway.commands._output import UsageError


def test_words_are_json_by_place_or_by_name() -> None:
    assert parse_arguments(["[0.3, -0.2]", '"left"', "speed=0.5", "deep={}"]) == (
        [[0.3, -0.2], "left"],
        {"speed": 0.5, "deep": {}},
    )


MEANT = [
    (["[0.3,", "-0.2]"], "forgot quotes? The shell splits at spaces: '[0.3, -0.2]'"),
    (["1", "side=[1,", "2]", "5"], "forgot quotes? The shell splits at spaces: '[1, 2]'"),
    (["left"], """forgot quotes? A text is written '"left"'"""),
    (["side=left"], """forgot quotes? A text is written '"left"'"""),
    (["NaN"], "JSON has no NaN and no infinity, and what moves takes neither"),
    (["[0.1, -Infinity]"], "JSON has no NaN and no infinity"),
    (["0,3"], "write numbers as 0.3, lists as '[0.3, -0.2]'"),
    (["[left]"], "forgot quotes?"),
    ([""], "forgot quotes?"),
]


@pytest.mark.parametrize(("words", "remedy"), MEANT, ids=str)
def test_a_word_that_is_no_json_is_answered_with_what_was_meant(words: list[str], remedy: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_arguments(words)
    assert remedy in str(refused.value)
