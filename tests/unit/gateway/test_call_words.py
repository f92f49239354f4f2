"""The words of ``trade call``: JSON, by place or by name, and what was probably meant by others."""

import json

import pytest

from trade_gateway._usage import UsageError
from trade_gateway.cli._output import Output
from trade_gateway.cli.services._call import parse_arguments


def test_arguments_are_json_by_position_or_by_name() -> None:
    assert parse_arguments(["[0.3, -0.2]", '"left"', "speed=0.5", "deep={}"]) == (
        [[0.3, -0.2], "left"],
        {"speed": 0.5, "deep": {}},
    )


def test_people_get_six_places_without_exponents_and_no_zero_below_zero(capsys: pytest.CaptureFixture[str]) -> None:
    state = {"a": -3.108e-05, "b": [-0.0, -1e-9, 1e-5, 0.1234567, 100.0], '"c": -1e-05': "\n -1e-05", "d": -1e-05}
    out = Output(as_json=False)
    for value in (-3.108e-05, state):
        out.data(value)
    alone, rest = capsys.readouterr().out.split("\n", 1)
    assert alone == "-0.000031"
    lines = [line.strip(" ,") for line in rest.splitlines()]
    assert lines[1] == '"a": -0.000031'
    assert lines[3:8] == ["0.0", "0.0", "0.00001", "0.123457", "100.0"]
    assert lines[9:11] == [r'"\"c\": -1e-05": "\n -1e-05"', '"d": -0.00001']


def test_programs_get_every_digit(capsys: pytest.CaptureFixture[str]) -> None:
    Output(as_json=True).data([-3.1080000001e-05, 0.12345678])
    assert json.loads(capsys.readouterr().out) == [-3.1080000001e-05, 0.12345678]


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
def test_an_argument_that_is_no_json_is_answered_with_a_suggestion(words: list[str], remedy: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_arguments(words)
    assert remedy in str(refused.value)
