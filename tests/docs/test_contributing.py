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
HOUSES: Final = {"trade": "trade", "drivers": "trade_drivers", "gateway": "trade_gateway", "hil-sim": "trade_hil_sim"}
"""By folder, the package that programs import; plug-ins for pytest are beside it."""


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
    for folder, package in HOUSES.items():
        packages = {path.parent for path in (ROOT / folder / "src").glob("*/__init__.py")}
        for house in sorted(packages, key=lambda path: (path.name != package, path)):
            yield f"| **`{house.relative_to(ROOT)}`** | {_first_line(house)} |\n"
            for room in sorted(path.parent for path in house.glob("*/**/__init__.py")):
                yield f"| `{room.relative_to(house)}` | {_first_line(room)} |\n"


def test_no_room_has_more_than_20_modules() -> None:
    sources = [path for folder in HOUSES for path in (ROOT / folder / "src").rglob("*.py")]
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
    for folder in HOUSES:
        source = ROOT / folder / "src"
        for path in source.rglob("*.py"):
            parts = path.relative_to(source).with_suffix("").parts
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
