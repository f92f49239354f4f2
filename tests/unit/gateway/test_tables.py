"""What people are shown on the command line: tables no wider than a terminal, and no more digits than they read."""

import json

import pytest

from trade_gateway.terminal._output import Output, table_lines

COLUMNS = ("SERVICE", "CALLED AS", "EFFECT", "HOST")
ROWS = [
    ("rosie.head.move_to", "move_to(positions_rad: list[float], speed_rad_s: float | None = None)", "actuate", "edge"),
    ("rosie.head.stop", "stop() -> None", "stop", "edge"),
]


def test_in_a_pipe_nothing_is_cut_or_left_out() -> None:
    lines = table_lines(COLUMNS, ROWS, None)
    assert len(lines) == 3
    assert [line.split("  ")[0] for line in lines] == ["SERVICE", "rosie.head.move_to", "rosie.head.stop"]
    assert all(text in line for row, line in zip(ROWS, lines[1:], strict=True) for text in row)


def test_columns_begin_one_below_the_other() -> None:
    lines = table_lines(COLUMNS, ROWS, None)
    places = [lines[0].index("EFFECT"), lines[1].index("actuate"), lines[2].index("  stop ") + 2]
    assert len(set(places)) == 1


@pytest.mark.parametrize("width", range(10, 130, 7))
def test_no_line_is_wider_than_the_terminal(width: int) -> None:
    assert max(map(len, table_lines(COLUMNS, ROWS, width))) <= width


def test_the_widest_column_is_cut_first() -> None:
    lines = table_lines(COLUMNS, ROWS, 80)
    assert lines[1].startswith("rosie.head.move_to  move_to(positions_rad: ")
    assert "…  actuate  edge" in lines[1]


def test_what_does_not_fit_is_left_out_and_named() -> None:
    head, *_, last = table_lines(COLUMNS, ROWS, 50)
    assert head.split() == ["SERVICE", "CALLED", "AS", "EFFECT"]
    assert last == "(HOST: in a wider terminal, or with --json)"


def test_people_get_no_more_digits_than_they_read_and_programs_get_all(capsys: pytest.CaptureFixture[str]) -> None:
    value = {
        "position_rad": 0.30000000000000004,
        "small": 0.0000123456789,
        "at": [1791234567.123456789, 3],
        "none": None,
    }
    Output(as_json=False).data(value)
    shown = capsys.readouterr().out
    assert json.loads(shown) == {"position_rad": 0.3, "small": 0.000012, "at": [1791234567.123457, 3], "none": None}
    Output(as_json=True).data(value)
    assert json.loads(capsys.readouterr().out) == value
