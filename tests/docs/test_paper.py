"""The page about the paper: every promise has one row, and what shows it exists or is "not yet"."""

import operator
import re
from functools import cache
from pathlib import Path

import pytest

import trade
from trade_gateway.cli import app

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
SHOWN = {
    number: re.sub(r"\s+", " ", names).strip()
    for number, names in re.findall(r"^- (P\d\d):\n((?:  .+\n)+)", PAGE.partition("## Shown by")[2], re.MULTILINE)
}
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if re.match(r"\| *P\d", line)
]


def _exists(named: str) -> bool:
    command, _, words = named.partition(" ")
    if command == "make":
        return f"\n{words.split()[0]}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
    if command == "trade":
        return words.split()[0] in {known.name for known in app.registered_commands}
    return named in _functions()


@cache
def _functions() -> set[str]:
    texts = (path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py"))
    return {name for text in texts for name in re.findall(r"\bdef (\w+)\(", text)}


def test_every_promise_has_exactly_one_row_in_order() -> None:
    assert [row[0] for row in ROWS] == [f"P{number:02}" for number in range(1, 76)] == list(SHOWN)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_promise_is_shown_by_tests_or_commands_that_exist(row: list[str]) -> None:
    number, promise, _ = row
    named = re.findall(r"`([^`]+)`", SHOWN[number])
    assert promise
    assert named
    assert [name for name in named if not _exists(name)] == []


def test_no_promise_is_left_open() -> None:
    assert "not yet" not in PAGE.lower()


@pytest.mark.parametrize("named", sorted(set(re.findall(r"`trade\.(\w[\w.]*)", PAGE))))
def test_what_the_page_offers_is_part_of_the_package(named: str) -> None:
    operator.attrgetter(named)(trade)


@pytest.mark.parametrize("named", ["test_that_nobody_wrote", "make coffee", "trade places", "test_a_promise"])
def test_what_does_not_exist_shows_nothing(named: str) -> None:
    assert not _exists(named)
