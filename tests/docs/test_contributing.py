"""CONTRIBUTING.md: its map has every room, and what it names exists."""

import ast
import os
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = ROOT / "CONTRIBUTING.md"
MARKS: Final = ("<!-- map: made by test_the_map_has_every_room -->\n", "<!-- end of map -->\n")
HOUSES: Final = {
    "trade": ".",
    "pytest_trade": ".",
    "trade_drivers": "drivers",
    "trade_gateway": "gateway",
    "trade_checks": "checks",
    "trade_robotfile": "robotfile",
    "trade_hil_sim": "hil-sim",
    "pytest_trade_hil_sim": "hil-sim",
}
"""Each package, and the folder that it is in."""


def test_the_map_has_every_room() -> None:
    """With WRITE_TABLES=1 in the environment the map is drawn again."""
    drawn = "\n| room | what it is for |\n|---|---|\n" + "".join(_rows()) + "\n"
    before, mark, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    shown, end, after = rest.partition(MARKS[1])
    if os.environ.get("WRITE_TABLES"):
        PAGE.write_text(before + mark + drawn + end + after, encoding="utf-8")
        return
    assert drawn == shown


def _rows() -> Iterator[str]:
    """Each package, each room in it, by the first line that it says of itself."""
    for package in HOUSES:
        house = _house(package)
        yield f"| **`{house.relative_to(ROOT)}`** | {_first_line(house)} |\n"
        for room in sorted(path.parent for path in _sources(package) if path.name == "__init__.py"):
            if room != house:
                yield f"| `{room.relative_to(house)}` | {_first_line(room)} |\n"


def _house(package: str) -> Path:
    return ROOT / HOUSES[package] / package


def _sources(package: str) -> list[Path]:
    return list(_house(package).rglob("*.py"))


def test_no_room_has_more_than_20_modules() -> None:
    sources = [path for package in HOUSES for path in _sources(package)]
    modules = Counter(path.parent for path in sources)
    assert len(modules) > 50
    assert {str(room): count for room, count in modules.items() if count > 20} == {}


def test_no_modules_import_each_other_while_they_are_loaded() -> None:
    """What a function imports when it runs, and what only types need, is not counted."""
    graph = {module: set(_loaded_with(module, path)) for module, path in _modules().items()}
    while leaves := [module for module, needs in graph.items() if not needs & graph.keys()]:
        for module in leaves:
            del graph[module]
    assert sorted(graph) == []


@cache
def _modules() -> dict[str, Path]:
    found: dict[str, Path] = {}
    for package, folder in HOUSES.items():
        for path in _sources(package):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def _loaded_with(module: str, path: Path) -> Iterator[str]:
    """The modules of this project that a module imports at its top level; packages that name them are left out."""
    known = _modules()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            outer = parts[: len(parts) - node.level + 1] if node.level else []
            base = ".".join([*outer, *([node.module] if node.module else [])])
            for alias in node.names:
                if f"{base}.{alias.name}" in known:
                    yield f"{base}.{alias.name}"
                elif base in known and base != module:
                    yield base


def _first_line(room: Path) -> str:
    said = ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8")))
    assert said, f"{room} says nothing of itself"
    return said.splitlines()[0].replace("``", "`")


def test_paths_and_targets_that_the_page_names_exist() -> None:
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    text = before + rest.partition(MARKS[1])[2]
    paths = re.findall(r"`((?:[\w.-]+/)+[\w.-]*)`", text)
    assert len(paths) > 5
    assert not [path for path in paths if not path.startswith((".venv/", ".uv/")) and not (ROOT / path).exists()]
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE))
    assert named
    assert named <= targets
