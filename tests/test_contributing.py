"""CONTRIBUTING.md: its map has every room, and what it names is there."""

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PAGE: Final = ROOT / "CONTRIBUTING.md"
MARKS: Final = ("<!-- map: made by test_the_map_has_every_room -->\n", "<!-- end of map -->\n")
HOUSES: Final = {"trade": "trade", "drivers": "trade_drivers", "gateway": "trade_gateway", "hil-sim": "trade_hil_sim"}
"""Packages by the folder they are in."""


def test_the_map_has_every_room() -> None:
    """With WRITE_TABLES=1 in the environment the map is drawn anew."""
    drawn = "\n| room | what it is for |\n|---|---|\n" + "".join(_rows()) + "\n"
    before, mark, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    shown, end, after = rest.partition(MARKS[1])
    if os.environ.get("WRITE_TABLES"):
        PAGE.write_text(before + mark + drawn + end + after, encoding="utf-8")
        return
    assert drawn == shown


def _rows() -> Iterator[str]:
    """Each package, each room in it, by the first line that it says of itself."""
    for folder, package in HOUSES.items():
        house = ROOT / folder / "src" / package
        yield f"| **`{house.relative_to(ROOT)}`** | {_first_line(house)} |\n"
        for room in sorted(path.parent for path in house.glob("*/__init__.py")):
            yield f"| `{room.name}` | {_first_line(room)} |\n"


def _first_line(room: Path) -> str:
    said = ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8")))
    assert said, f"{room} says nothing of itself"
    return said.splitlines()[0].replace("``", "`")


def test_paths_and_targets_that_it_names_are_there() -> None:
    text = PAGE.read_text(encoding="utf-8")
    paths = re.findall(r"`((?:[\w.-]+/)+[\w.-]*)`", text)
    assert len(paths) > 5
    assert not [path for path in paths if not path.startswith((".venv/", ".uv/")) and not (ROOT / path).exists()]
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE))
    assert named
    assert named <= targets
