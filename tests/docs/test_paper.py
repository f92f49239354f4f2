"""The page about the paper: every promise has one row, and what shows it exists or is "not yet"."""

import operator
import re
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
NOT_YET = re.compile(r"(?:^|\. )not yet: (?P<reason>\S+ .+)$", re.IGNORECASE)


def _shows_something(shown_by: str) -> bool:
    """Whether tests or commands stand before what is not there yet, and all of them exist."""
    named = re.findall(r"`([^`]+)`", NOT_YET.sub("", shown_by))
    missing = [name for name in named if not _exists(name)]
    assert not missing
    return bool(named)


def _exists(named: str) -> bool:
    command, _, words = named.partition(" ")
    if command == "make":
        return f"\n{words.split()[0]}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
    if command == "trade":
        return words.split()[0] in {known.name for known in app.registered_commands}
    tests = (path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py"))
    return any(re.search(rf"\bdef {re.escape(named)}\(", text) for text in tests)


def test_every_promise_has_exactly_one_row_in_order() -> None:
    assert [row[0] for row in ROWS] == [f"P{number:02}" for number in range(1, 76)] == list(SHOWN)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_promise_is_shown_or_said_to_be_not_yet(row: list[str]) -> None:
    number, promise, _ = row
    shown_by = SHOWN[number]
    assert promise
    said_not_yet = NOT_YET.search(shown_by)
    assert _shows_something(shown_by) or said_not_yet
    assert bool(said_not_yet) == ("not yet" in shown_by.lower()), "say 'not yet: ' and the reason"


def test_nothing_is_not_yet_but_what_is_left_for_later_on_purpose() -> None:
    """Bounds under load."""
    assert [number for number, names in SHOWN.items() if NOT_YET.search(names)] == ["P12"]


@pytest.mark.parametrize("named", sorted(set(re.findall(r"`trade\.(\w[\w.]*)", PAGE))))
def test_what_the_page_offers_is_part_of_the_package(named: str) -> None:
    operator.attrgetter(named)(trade)


@pytest.mark.parametrize("named", ["test_that_nobody_wrote", "make coffee", "trade places", "test_a_promise"])
def test_what_does_not_exist_shows_nothing(named: str) -> None:
    assert not _exists(named)
