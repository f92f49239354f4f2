"""The words of ``trade call``: JSON, by place or by name, and what was probably meant by others."""

import json
from enum import Enum
from typing import Any

import pytest

from trade import service
from trade.protocol.messages import ServiceInfo
from trade.testing import memory_system
from trade_gateway._usage import UsageError
from trade_gateway.cli.services._call import parse_arguments
from trade_gateway.terminal._output import Output

pytestmark = pytest.mark.virtual_time


class Side(Enum):
    LEFT = "left"
    RIGHT = "right"


class Arm:
    @service
    def reach(
        self,
        positions_rad: list[float],
        side: str = "",
        speed_rad_s: float | None = None,
        which: Side | None = None,
        count: int | str = 0,
        note: str | None = None,
        anything: Any = None,
        firmly: bool = False,
    ) -> None: ...


@pytest.fixture
def info() -> ServiceInfo:
    with memory_system() as system:
        return system.container("me").register(Arm())[0].record.info


def test_arguments_are_json_by_position_or_by_name(info: ServiceInfo) -> None:
    assert parse_arguments(["[0.3, -0.2]", '"left"', "speed_rad_s=0.5", "anything={}"], info) == (
        [[0.3, -0.2], "left"],
        {"speed_rad_s": 0.5, "anything": {}},
    )


TEXTS = [
    ("side=left", "left"),
    ("side=5", "5"),
    ("side=true", "true"),
    ("side=null", "null"),
    ('side="left"', "left"),
    ("side=the left one", "the left one"),
    ("which=right", "right"),
    ("which=null", None),
    ("note=null", None),
    ("note=5", "5"),
    ("count=5", 5),
    ("count=five", "five"),
    ('anything="five"', "five"),
]


@pytest.mark.parametrize(("word", "value"), TEXTS, ids=str)
def test_a_word_is_a_text_where_the_service_takes_a_text(info: ServiceInfo, word: str, value: object) -> None:
    assert parse_arguments([word], info) == ([], {word.partition("=")[0]: value})


def test_the_place_of_a_word_says_which_argument_it_is(info: ServiceInfo) -> None:
    assert parse_arguments(["[]", "5", "0.5", "left", "6"], info)[0] == [[], "5", 0.5, "left", 6]


ANGLES = [
    ("positions_rad=[30deg, -90deg]", [0.5236, -1.5708]),
    ("positions_rad=[30°,0.5]", [0.5236, 0.5]),
    ("speed_rad_s=180deg", 3.1416),
    ("speed_rad_s=-22.5deg/s", -0.3927),
]


@pytest.mark.parametrize(("word", "value"), ANGLES, ids=str)
def test_angles_may_be_in_degrees(info: ServiceInfo, word: str, value: object) -> None:
    [angle] = parse_arguments([word], info)[1].values()
    assert angle == pytest.approx(value, abs=1e-4)


@pytest.mark.parametrize(
    "word", ["anything=30deg", "count=[30deg]", "positions_rad=[30degs]", "positions_rad=[x30deg]"]
)
def test_what_is_no_angle_is_not_in_degrees(info: ServiceInfo, word: str) -> None:
    with pytest.raises(UsageError, match="is not JSON"):
        parse_arguments([word], info)


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
    (["1", "positions_rad=[1,", "2]", "5"], "forgot quotes? The shell splits at spaces: '[1, 2]'"),
    (["left"], "argument 'left': positions_rad takes a list, and 'left' is a text"),
    (["speed_rad_s=fast"], "argument 'speed_rad_s=fast': speed_rad_s takes a number, and 'fast' is a text"),
    (["firmly=True"], "argument 'firmly=True': firmly takes true or false, and 'True' is a text"),
    (["anything=left"], """forgot quotes? A text is written '"left"'"""),
    (["NaN"], "JSON has no NaN and no infinity, and what moves takes neither"),
    (["[0.1, -Infinity]"], "JSON has no NaN and no infinity"),
    (["0,3"], "write numbers as 0.3, lists as '[0.3, -0.2]'"),
    (["[left]"], "forgot quotes?"),
    ([""], "forgot quotes?"),
]


@pytest.mark.parametrize(("words", "remedy"), MEANT, ids=str)
def test_an_argument_that_is_no_json_is_answered_with_a_suggestion(
    info: ServiceInfo, words: list[str], remedy: str
) -> None:
    with pytest.raises(UsageError) as refused:
        parse_arguments(words, info)
    assert remedy in str(refused.value)
