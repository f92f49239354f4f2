"""The rules of motion, wire by wire: each cell of the table names tests of that very kind of wire."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
TABLE = PAGE.split("## On each kind of wire")[1]
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in TABLE.splitlines() if line.startswith("| S")]
REQUIRED = {"S01", "S06", "S08", "S11", "S18"}
RIGS = {
    "Dynamixel": "Rig",
    "CAN": "(?:Leg|CanRig)",
    "Modbus": "HandRig",
    "Feetech": "TailRig",
    "ODrive and Damiao": "(?:MotorRig|CanRig)",
    "UR": "ArmRig",
}
"""What a test of the wire is done with: the parameters of a test say which wire it is about."""


def judged_on(wire: str) -> set[str]:
    """The tests of drivers that have that wire's simulated bus in their hands."""
    given = re.compile(rf"def (test_\w+)\((?=[^)]*\b\w+: {RIGS[wire]}\b)")
    modules = (ROOT / "tests" / "unit" / "drivers").glob("test_*.py")
    return {name for module in modules for name in given.findall(module.read_text(encoding="utf-8"))}


def test_every_rule_that_a_wire_can_judge_has_one_row() -> None:
    rules = [row[0] for row in ROWS]
    assert rules == sorted(set(rules))
    assert set(rules) >= REQUIRED
    assert set(rules) <= set(re.findall(r"^\| \*\*(S\d\d) ", PAGE, re.MULTILINE))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
@pytest.mark.parametrize(("column", "wire"), list(enumerate(RIGS, 1)), ids=list(RIGS))
def test_a_cell_names_tests_of_its_wire(row: list[str], column: int, wire: str) -> None:
    named = set(re.findall(r"`(test_\w+)`", row[column]))
    assert named
    assert named <= judged_on(wire)


def test_what_is_marked_runs_on_socketcan_too() -> None:
    marked = set(re.findall(r"`(test_\w+)`\*", TABLE))
    module = (ROOT / "tests" / "system" / "socketcan" / "test_rules.py").read_text(encoding="utf-8")
    imported = set(re.findall(r"\b(test_S\w+)", module))
    assert marked
    assert marked <= imported
    assert {name[5:8] for name in marked} >= REQUIRED


def test_a_test_of_one_wire_is_none_of_another() -> None:
    assert not judged_on("CAN") & {"test_S11_who_has_no_lock_writes_nothing"}
    assert "test_S11_who_has_no_lock_sends_nothing" in judged_on("CAN")
