"""The programs that tests keep as texts, and run in processes, import names that exist.

No type checker reads them, and some belong to tests that the gate does not run.
"""

import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = "trade|trade_drivers|trade_gateway|trade_hil_sim|trade_robotfile|pytest_trade|tests"
IMPORTS = re.compile(rf"^\s*from ((?:{PACKAGES})(?:\.\w+)*) import (\([^)]*\)|[^\n#;]*)", re.MULTILINE)
TEXTS = re.compile(r'"""(.*?)"""|"((?:[^"\\\n]|\\.)*)"', re.DOTALL)
FILES = [path for path in sorted((ROOT / "tests").rglob("*.py")) if path != Path(__file__)]


def imported_in_texts(path: Path) -> Iterator[tuple[str, str]]:
    """The modules and the names that the texts of a file import from them."""
    for long, short in TEXTS.findall(path.read_text()):
        for module, names in IMPORTS.findall(long or short.replace(r"\n", "\n")):
            for name in re.sub(r"\bas\s+\w+", "", names).strip("()").split(","):
                yield module, name.strip()


def exists(module: str, name: str) -> bool:
    if hasattr(importlib.import_module(module), name):
        return True
    try:
        importlib.import_module(f"{module}.{name}")
    except ModuleNotFoundError:
        return False
    return True


def test_programs_in_texts_import_what_exists() -> None:
    found = [(path, *one) for path in FILES for one in imported_in_texts(path)]
    assert len(found) > 50
    assert [(str(path), module, name) for path, module, name in found if name and not exists(module, name)] == []


@pytest.mark.parametrize(("name", "real"), [("Retention", True), ("Keep", False)])
def test_a_name_that_was_changed_is_found(name: str, real: bool) -> None:
    assert exists("trade._audit.store", name) is real
