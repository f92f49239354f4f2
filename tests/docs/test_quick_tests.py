"""What `make test` leaves out: never the only test of a promise, a rule, a complaint, a fault or a contract."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.contract.complaints.test_page import PROVEN, names
from tests.docs.test_paper import SHOWN
from tests.docs.test_safety_page import RULES, TESTS

ROOT = Path(__file__).parents[2]
STORIES = {
    "the gateway": "test_a_service_is_visible_and_callable_only_once_it_is_exported",
    "HTTP": "test_S03_motion_of_a_page_stops_when_the_http_gateway_ends",
    "the dashboard": "test_a_joint_moves_while_its_button_is_held_and_no_longer",
    "ROS 1": "test_a_local_lock_holds_against_ros_and_a_ros_lock_against_local_callers",
    "Rust": "test_it_passes_every_mandatory_check",
}
WHOLE = [
    *sorted((ROOT / "tests" / "contract").glob("test_*.py")),
    ROOT / "tests" / "unit" / "drivers" / "test_fault_table.py",
    *sorted((ROOT / "tests" / "unit" / "trade").glob("test_transport_*.py")),
]


def _tests(module: Path) -> Iterator[tuple[str, bool]]:
    """Each test function of a module, and whether `make test` runs it."""
    tree = ast.parse(module.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_"):
            yield node.name, not any(map(_is_slow, (*_marks_of_all(tree), *node.decorator_list)))


def _marks_of_all(tree: ast.Module) -> list[ast.expr]:
    return [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets) == "pytestmark"
    ]


def _is_slow(mark: ast.expr) -> bool:
    return "pytest.mark.slow" in ast.unparse(mark)


MODULES = [path for path in (ROOT / "tests").rglob("test_*.py") if "socketcan" not in path.parts]
QUICK = {name for module in MODULES for name, quick in _tests(module) if quick}


@pytest.mark.parametrize("rule", [rule for rule, _ in RULES])
def test_each_rule_of_motion_has_a_quick_test(rule: str) -> None:
    assert {shown.name for shown in TESTS if shown.rule == rule} & QUICK


@pytest.mark.parametrize("promise", SHOWN)
def test_each_promise_of_the_paper_has_a_quick_test(promise: str) -> None:
    named = re.findall(r"`(\w+)`", SHOWN[promise])
    assert not named or set(named) & QUICK


@pytest.mark.parametrize("row", PROVEN, ids=lambda row: row[0])
def test_each_complaint_has_a_quick_test(row: list[str]) -> None:
    assert set(names(row[1])) & QUICK


@pytest.mark.parametrize("module", WHOLE, ids=lambda module: module.stem)
def test_faults_contracts_and_the_conformance_of_transports_are_quick_as_a_whole(module: Path) -> None:
    assert [name for name, quick in _tests(module) if not quick] == []


@pytest.mark.parametrize("story", STORIES.values(), ids=STORIES)
def test_each_way_into_a_system_has_a_quick_story(story: str) -> None:
    assert story in QUICK
