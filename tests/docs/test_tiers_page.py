"""docs/testing.md counts what `make test` shows; and no test of `make test` has an upper bound on real time."""

import ast
import os
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from tests.contract.complaints.test_page import PROVEN, names
from tests.docs.test_paper import SHOWN
from tests.docs.test_safety_page import RULES
from tests.docs.test_safety_page import TESTS as OF_RULES
from tests.support.tiers import in_system_folder
from tests.unit.drivers.fault_subjects import OWN_CLOCK
from tests.unit.drivers.fault_table import TABLE

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = ROOT / "docs"
PAGE: Final = DOCS / "testing.md"
MARKS: Final = ("<!-- made by test_the_page_counts_what_make_test_shows -->\n", "<!-- end of table -->\n")
FAULT_TESTS: Final = {
    "test_a_fault_while_moving_ends_the_move_and_nothing_moves_on_recovery",
    "test_a_small_fault_goes_unnoticed",
}
"""Each row of docs/faults.md is a parameter of one of them."""
REAL_CLOCK: Final = {row.name for row in TABLE if row.device in OWN_CLOCK}
"""The rows of faults whose parameter is marked realtime."""
CLOCKS: Final = {"monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "time", "time_ns"}


class Found(NamedTuple):
    """A test by name."""

    name: str
    gate: bool
    """Whether `make test` runs it."""
    virtual: bool
    """Whether its time is virtual, which has no lateness."""
    path: Path
    node: ast.AST


@cache
def all_tests() -> tuple[Found, ...]:
    return tuple(test for path in sorted((ROOT / "tests").rglob("test_*.py")) for test in _tests_of(path))


def _tests_of(path: Path) -> Iterator[Found]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    marks = [node.value for node in tree.body if isinstance(node, ast.Assign) and _is_pytestmark(node)]
    below = in_system_folder(path) or _has(marks, "realtime", "system")
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_"):
            own = node.decorator_list
            virtual = _has([*marks, *own], "virtual_time") and not _has(own, "real_clock")
            yield Found(node.name, not (below or _has(own, "realtime", "system")), virtual, path, node)


def _is_pytestmark(node: ast.Assign) -> bool:
    return any(isinstance(target, ast.Name) and target.id == "pytestmark" for target in node.targets)


def _has(marks: Sequence[ast.expr], *names: str) -> bool:
    return any(isinstance(node, ast.Attribute) and node.attr in names for mark in marks for node in ast.walk(mark))


def shown() -> dict[str, dict[str, set[str]]]:
    """For each kind of row, the rows and the tests that they name."""
    return {
        "safety rules": {rule: {shown.name for shown in OF_RULES if shown.rule == rule} for rule, _ in RULES},
        "promises of the paper": {row: set(re.findall(r"`(test_\w+)", named)) for row, named in SHOWN.items()},
        "complaints": {row[0]: set(names(row[1])) for row in PROVEN},
        "faults of devices": {row.name: FAULT_TESTS for row in TABLE},
    }


def test_every_rule_promise_complaint_and_fault_is_named_by_a_test() -> None:
    every = {test.name for test in all_tests()}
    lacking = [row for rows in shown().values() for row, names in rows.items() if not names & every]
    assert lacking == []


def test_the_page_counts_what_make_test_shows() -> None:
    """With WRITE_TABLES=1 in the environment, the table is written again."""
    gate = {test.name for test in all_tests() if test.gate}
    lines = ["\n| what | rows | with a test in `make test` |\n|---|---|---|\n"]
    for kind, rows in shown().items():
        count = sum(bool(names & gate) for row, names in rows.items() if row not in REAL_CLOCK)
        lines.append(f"| {kind} | {len(rows)} | {count} |\n")
    drawn = "".join([*lines, "\n"])
    before, mark, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    kept, end, after = rest.partition(MARKS[1])
    if os.environ.get("WRITE_TABLES"):
        PAGE.write_text(before + mark + drawn + end + after, encoding="utf-8")
        return
    assert drawn == kept


def test_no_test_of_make_test_has_an_upper_bound_on_real_time() -> None:
    """A computer may be slow at any moment: a wait ends by a condition."""
    real = [test for test in all_tests() if test.gate and not test.virtual]
    assert [f"{test.path.name}::{test.name}" for test in real if _has_upper_bound(test.node)] == []


@pytest.mark.parametrize(
    ("body", "bounded"),
    [
        ("began = time.monotonic()\n    work()\n    assert time.monotonic() - began < 3", True),
        ("took = time.monotonic() - began\n    assert took <= 3", True),
        ("assert 3 > time.perf_counter() - began", True),
        ("assert time.monotonic() - began < PATIENCE_S", False),
        ("assert began < mover.at < time.monotonic()", False),
        ("assert time.monotonic() - began >= 3", False),
        ("wait_until(lambda: time.monotonic() > began + 3)", False),
    ],
)
def test_upper_bounds_are_recognised(body: str, bounded: bool) -> None:
    assert _has_upper_bound(ast.parse(f"def test_it():\n    {body}")) == bounded


def _has_upper_bound(test: ast.AST) -> bool:
    durations = {
        target.id
        for node in ast.walk(test)
        if isinstance(node, ast.Assign) and _is_duration(node.value, set())
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    asserted = (node.test for node in ast.walk(test) if isinstance(node, ast.Assert))
    compared = (node for each in asserted for node in ast.walk(each) if isinstance(node, ast.Compare))
    return any(_bounds_above(node, durations) for node in compared)


def _bounds_above(compared: ast.Compare, durations: set[str]) -> bool:
    sides = [compared.left, *compared.comparators]
    for left, operator, right in zip(sides, compared.ops, sides[1:], strict=False):
        if isinstance(operator, ast.Lt | ast.LtE) and _is_duration(left, durations) and not _is_patience(right):
            return True
        if isinstance(operator, ast.Gt | ast.GtE) and _is_duration(right, durations):
            return True
    return False


def _is_patience(bound: ast.expr) -> bool:
    """What `wait_until` waits at most: it ends a test that hangs."""
    return isinstance(bound, ast.Name) and bound.id == "PATIENCE_S"


def _is_duration(node: ast.expr, durations: set[str]) -> bool:
    if isinstance(node, ast.Name):
        return node.id in durations
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) and any(map(_reads_clock, ast.walk(node)))


def _reads_clock(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in CLOCKS
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == "time"
    )
