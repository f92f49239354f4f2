"""docs/architecture.md: each room exists, and each step of its walks is in the file that it links to.

A link to a source file is followed by a colon and names in backticks: these are defined in that file.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

import pytest
from msgspec import toml

from tests.docs.blocks import DOCS, ROOT, blocks
from trade import Container

PAGE: Final = DOCS / "architecture.md"
TEXT: Final = PAGE.read_text(encoding="utf-8")
PACKAGES: Final = {
    "trade": ".",
    "trade_drivers": "drivers",
    "trade_gateway": "gateway",
    "trade_checks": "checks",
    "trade_hil_sim": "hil-sim",
}
"""Where each of them is."""
DOORS: Final = "What other packages need of trade has a public name"
LAYERS: Final = "The rooms of trade: each imports only from those below it"
LINKS: Final = re.findall(r"\[([^\]]+)\]\(([^)#]+)\)(:\s+(?:`[\w.]+`(?:,\s+)?)+)?", TEXT)
"""Text, target, and the names behind the colon."""
TARGETS: Final = sorted({target for _, target, _ in LINKS})
STEPS: Final = re.findall(r"^\d+\. .*\n(?: {3,}.*\n)*", TEXT, re.MULTILINE)


@pytest.mark.parametrize("target", TARGETS)
def test_a_link_leads_to_a_file(target: str) -> None:
    assert (DOCS / target).is_file()


def test_the_text_of_a_link_is_the_end_of_its_path() -> None:
    assert [text for text, target, _ in LINKS if not target.endswith(f"/{text}")] == []


def test_each_step_and_each_place_has_a_link_with_names() -> None:
    places = TEXT.partition("## Where is")[2].splitlines()
    rows = [line for line in places if line.startswith("| ")][1:]
    assert len(STEPS) > 40
    assert len(rows) > 10
    assert [text for text in (*STEPS, *rows) if not re.search(r"\]\([^)]+\.py\): `", re.sub(r"\s+", " ", text))] == []
    assert [target for _, target, names in LINKS if not names] == []


@pytest.mark.parametrize("target", TARGETS)
def test_names_behind_a_link_are_defined_in_that_file(target: str) -> None:
    named = {name for _, to, names in LINKS if to == target for name in re.findall(r"`([\w.]+)`", names)}
    assert named
    assert named - defined(DOCS / target) == set()


def test_methods_that_steps_name_are_defined_in_files_that_the_page_links_to() -> None:
    """Also those that stand in the middle of a sentence; what `Container` has may come from its bases."""
    known = {f"Container.{name}" for name in dir(Container)}.union(*(defined(DOCS / target) for target in TARGETS))
    named = {name for step in STEPS for name in re.findall(r"`(_?[A-Z]\w+(?:\.\w+)?)`", step)}
    assert len(named) > 50
    assert named - known == set()


@cache
def defined(path: Path) -> frozenset[str]:
    """Functions and classes of a module, and ``Class.method``."""
    return frozenset(_defined(ast.parse(path.read_text(encoding="utf-8"))))


def _defined(module: ast.Module) -> Iterator[str]:
    for node in module.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        if isinstance(node, ast.ClassDef):
            yield from (f"{node.name}.{one.name}" for one in node.body if isinstance(one, ast.FunctionDef))


def shown() -> dict[str, dict[str, set[str]]]:
    """The page: by package and room, the classes that its row names."""
    found: dict[str, dict[str, set[str]]] = {package: {} for package in PACKAGES}
    package = "trade"
    for cells in re.findall(r"^\| (.+?) \| (?:.* \| )?(.*?)\|$", TEXT.partition("## A call")[0], re.MULTILINE):
        if heading := re.fullmatch(r"\*\*`(\w+)`\*\*", cells[0]):
            package = heading[1]
            continue
        for room in re.findall(r"`(\w+)`", cells[0]):
            found[package][room] = set(re.findall(r"`(\w+)`", cells[1]))
    return found


@cache
def rooms(package: str) -> dict[str, Path]:
    """The folders directly in a package, by name."""
    return {path.parent.name: path.parent for path in (ROOT / PACKAGES[package] / package).glob("*/__init__.py")}


@pytest.mark.parametrize("package", PACKAGES)
def test_each_room_has_a_row(package: str) -> None:
    assert len(rooms(package)) > (1 if package == "trade_checks" else 5)
    assert sorted(shown()[package]) == sorted(rooms(package))


@pytest.mark.parametrize("package", PACKAGES)
def test_classes_of_a_row_are_in_its_rooms(package: str) -> None:
    rows: dict[frozenset[str], set[str]] = {}
    for room, classes in shown()[package].items():
        rows.setdefault(frozenset(classes), set()).add(room)
    for classes, together in rows.items():
        sources = [path for room in together for path in rooms(package)[room].rglob("*.py")]
        assert classes
        assert classes - frozenset[str]().union(*map(defined, sources)) == set(), together


def test_the_picture_has_the_layers_that_are_checked() -> None:
    [picture] = blocks(PAGE, "text")
    project: dict[str, Any] = toml.decode((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    [layers] = [one["layers"] for one in contracts if one["name"] == LAYERS]
    checked = [re.sub(r"\btrade\.", "", layer) for layer in layers]
    wanted = [layer for layer in checked if layer.partition(" ")[0] in rooms("trade")]
    lines = picture.text.partition(" trade: ")[2].splitlines()
    drawn = [re.search(r" {2,}((?:\w+(?:, | \| )?)+)$", line) for line in lines]
    assert [layer for row in drawn if row for layer in row[1].split(", ")] == wanted


def test_the_contract_on_private_modules_names_each_of_them() -> None:
    contracts = toml.decode((ROOT / "pyproject.toml").read_bytes())["tool"]["importlinter"]["contracts"]
    [named] = [one["forbidden_modules"] for one in contracts if one["name"] == DOORS]
    private = {
        path.stem for path in (ROOT / "trade").glob("_*") if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert named == sorted(f"trade.{name}" for name in private if not name.startswith("__"))
