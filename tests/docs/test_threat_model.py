"""The page of threats: each is tried by tests that exist, and what it says of the code is so."""

import ast
import re
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = (ROOT / "docs" / "threat-model.md").read_text(encoding="utf-8")
COLUMNS: Final = 4
ROWS: Final = [
    cells
    for line in PAGE.splitlines()
    if len(cells := [cell.strip() for cell in line.strip().removeprefix("|").removesuffix("|").split("|")]) == COLUMNS
    and cells[0] not in {"threat", "---"}
]
LISTED: Final = dict(
    re.findall(r"^- (.+):\n((?:  `.+\n)+)", PAGE.partition("## Tests of each threat")[2], re.MULTILINE)
)
ASKED: Final = [
    *("replay", "forged", "stolen token", "nested calls", "hooks", "notifications", "class paths", "deserialisation"),
    *("traversal", "CSRF", "WebSocket", "flood", "certificate", "secrets in logs"),
]
RUNS_CODE: Final = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "yaml", "xml.etree", "jsonpickle"}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_each_threat_is_tried_by_tests_that_exist(row: list[str]) -> None:
    listed = LISTED[row[0]]
    named = re.findall(r"`([\w/]+\.py)::(test_\w+)`", listed)
    assert len(named) == listed.count("`") // 2 > 0
    for module, test in named:
        text = (ROOT / "tests" / module).read_text(encoding="utf-8")
        assert re.search(rf"def {test}\(", text), f"{module} has no {test}"


def test_no_threat_that_was_asked_about_is_left_out() -> None:
    reported = "\n".join(f"{row[0]} {row[1]}" for row in ROWS)
    assert not [threat for threat in ASKED if threat not in reported]
    assert len({row[0] for row in ROWS}) == len(ROWS)
    assert [row[0] for row in ROWS] == list(LISTED)


def _modules() -> list[Path]:
    rooms = ("trade", "checks", "drivers", "gateway", "hil-sim", "robotfile")
    return [path for room in rooms for path in (ROOT / room).rglob("*.py")]


def test_nothing_is_unpickled_or_evaluated() -> None:
    found: list[str] = []
    for path in _modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Import(names=names):
                    found += [f"{path}: {name.name}" for name in names if name.name in RUNS_CODE]
                case ast.ImportFrom(module=str() as module):
                    found += [f"{path}: {module}"] if module in RUNS_CODE else []
                case ast.Call(func=ast.Name(id="eval" | "exec" | "compile" as name)):
                    found.append(f"{path}: {name}")
                case _:
                    pass
    assert not found
