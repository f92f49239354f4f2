"""The page of complaints and the tests say the same, both ways."""

import importlib
import re
from pathlib import Path

from tests.contract.complaints.table import COMPLAINTS

HERE = Path(__file__).parent
PAGE = (HERE.parents[2] / "docs" / "complaints.md").read_text(encoding="utf-8")
TOP, _, END = PAGE.partition("## Tests and mutants")
REPORTED, _, TRIED = TOP.partition("## From trials of TRADE")


def rows(part: str) -> list[list[str]]:
    """The cells of the table in a part of the page, without its heading."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if line[:2] == "| "][1:]


ROWS, PROVEN = rows(REPORTED), rows(END)
NAMES = [row[0] for row in ROWS + rows(TRIED)]


def shown() -> dict[str, set[str]]:
    for module in HERE.glob("test_*.py"):
        importlib.import_module(f"tests.contract.complaints.{module.stem}")
    return {name: {row.mutant.__name__ for row in rows} for name, rows in COMPLAINTS.items()}


def names(cell: str) -> list[str]:
    return re.findall(r"`(\w+)`", cell)


def test_all_complaints_of_other_projects_name_a_linked_source() -> None:
    assert len(set(NAMES)) == len(NAMES)
    linked = dict(re.findall(r"^\[(.+)\]: (https://github\.com/.+)$", PAGE, re.MULTILINE))
    named = [re.findall(r"\[([^]]+)\]", row[1]) for row in ROWS]
    assert all(named)
    assert sorted(linked) == sorted(name for names_ in named for name in names_)
    assert [row[0] for row in PROVEN] == NAMES


def test_each_complaint_has_tests_of_its_name_and_each_test_is_a_complaints() -> None:
    reported = {name: row[0] for row in PROVEN for name in names(row[1])}
    assert set(reported) == set(shown())
    for test, words in reported.items():
        assert test.startswith("test_" + re.sub(r"\W+", "_", words.lower().replace("wi-fi", "wifi")))


def test_each_complaint_names_the_mutants_of_its_tests() -> None:
    made = shown()
    for row in PROVEN:
        assert set(names(row[2])) == set().union(*(made[test] for test in names(row[1]))), row[0]


def test_no_mutant_is_left_over() -> None:
    used = set().union(*shown().values())
    defined = {
        name
        for module in HERE.glob("*_mutants.py")
        for name in re.findall(r"^def ([a-z]\w*)\(", module.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert defined == used
