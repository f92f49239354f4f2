"""The rules of motion and their tests: each rule has some, and ten have some on each kind of wire."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.contract.rigs.vendors import RIGS as VENDORS
from tests.contract.rigs.vendors import rules_of

ROOT = Path(__file__).parents[2]
RULES = re.findall(r"^### (S\d\d) (.+)$", (ROOT / "docs" / "safety.md").read_text(encoding="utf-8"), re.MULTILINE)
APPENDIX = ROOT / "docs" / "safety-tests.md"
MODULES = sorted((ROOT / "tests").rglob("test_*.py"), key=lambda path: (path.name, path))
ON_EACH_WIRE = ["S01", "S05", "S06", "S07", "S08", "S11", "S18", "S19", "S20", "S22"]
ON_SOCKETCAN = {"S01", "S06", "S08", "S11", "S18"}
RIGS = {
    "Dynamixel": "Rig",
    "CiA 402": "(?:Leg|CanRig)",
    "2F-85": "HandRig",
    "Feetech": r"(?:Rig \| )?TailRig",
    "ODrive, Damiao": "(?:MotorRig|CanRig)",
    "UR": "ArmRig",
}
"""The parameter of a driver's test that says which wire it is about."""
UNNUMBERED = {
    "test_a_damiao_is_watched_from_attaching_on": "S06",
    "test_an_odrive_without_a_watchdog_is_not_enabled": "S06",
    "test_an_e_stop_is_not_cleared_without_the_right": "S09",
    "test_a_fault_while_moving_ends_the_move_and_nothing_moves_on_recovery": "S18",
    "test_closing_the_driver_keeps_what_is_held": "S19",
    "test_closing_the_driver_stops_moving_fingers": "S19",
}
"""Tests of a rule whose names do not have its number."""
HEAD = """# Tests of the safety rules

For reviewers who want to check how a rule of motion is tested.
After reading, you can find and run the tests of each of the [safety rules](safety.md).

`WRITE_TABLES=1 pytest tests/docs/test_safety_page.py` writes this page. The column *wire* names the device whose
bytes or frames the test checks. Tests marked SocketCAN also run on a kernel interface (`make test-socketcan`).
"""


class Shown(NamedTuple):
    """A test of a rule."""

    rule: str
    name: str
    module: str
    wires: tuple[str, ...]


def _tests() -> Iterator[Shown]:
    on_socketcan = _imported_on_socketcan()
    for path in MODULES:
        text, of_driver = path.read_text(encoding="utf-8"), "drivers" in path.parts
        for name, given in re.findall(r"^ *(?:async )?def (test_\w+)\(([^)]*)\)", text, re.MULTILINE):
            rules = re.findall(r"_(S\d\d)(?=_)", name) or UNNUMBERED.get(name, "").split()
            wires = [wire for wire, rig in RIGS.items() if of_driver and re.search(rf"\b\w+: {rig}\b", given)]
            wires += _judged_by_the_contract(name) if path.parent.name == "contract" else []
            wires += ["SocketCAN"] * ("CiA 402" in wires and (path.stem, name) in on_socketcan)
            yield from (Shown(rule, name, path.name, tuple(wires)) for rule in rules)


def _judged_by_the_contract(rule: str) -> list[str]:
    return list(dict.fromkeys(made.column for made in VENDORS.values() if rule in rules_of(made)))


def _imported_on_socketcan() -> set[tuple[str, str]]:
    [module] = (path for path in MODULES if path.match("socketcan/test_rules.py"))
    imports = re.findall(
        r"^from [\w.]*?(\w+) import ([^(\n]+|\([^)]+\))", module.read_text(encoding="utf-8"), re.MULTILINE
    )
    return {(stem, name) for stem, names in imports for name in re.findall(r"test_\w+", names)}


TESTS = list(_tests())


def test_the_rules_are_numbered_in_order_and_each_has_tests() -> None:
    assert [rule for rule, _ in RULES] == [f"S{number:02}" for number in range(1, 24)]
    assert {shown.rule for shown in TESTS} == {rule for rule, _ in RULES}


@pytest.mark.parametrize("rule", ON_EACH_WIRE)
@pytest.mark.parametrize("wire", RIGS)
def test_each_kind_of_wire_has_tests_of_the_rule(rule: str, wire: str) -> None:
    assert [shown for shown in TESTS if shown.rule == rule and wire in shown.wires]


def test_the_main_rules_run_on_socketcan_too() -> None:
    assert {shown.rule for shown in TESTS if "SocketCAN" in shown.wires} >= ON_SOCKETCAN


def test_a_test_of_one_wire_is_none_of_another() -> None:
    on_can = {shown.name for shown in TESTS if "CiA 402" in shown.wires}
    assert "test_S22_one_value_outside_refuses_the_whole_group" not in on_can
    assert "test_S18_a_moving_drive_without_an_owner_is_stopped_and_left_enabled" in on_can


def test_tests_without_a_number_exist() -> None:
    assert UNNUMBERED.keys() <= {shown.name for shown in TESTS}


def test_the_appendix_lists_the_tests_of_each_rule() -> None:
    """With WRITE_TABLES=1 in the environment it is written again."""
    text = HEAD + "".join(f"\n## {rule} {title}\n\n{_table(rule)}" for rule, title in RULES)
    text += f"\n## Rules that do not apply\n\n{_lacking()}"
    if os.environ.get("WRITE_TABLES"):
        APPENDIX.write_text(text, encoding="utf-8")
    assert APPENDIX.read_text(encoding="utf-8") == text


def _table(rule: str) -> str:
    rows = sorted({shown[1:] for shown in TESTS if shown.rule == rule})
    return "| test | file | wire |\n|---|---|---|\n" + "".join(
        f"| `{name}` | {module} | {', '.join(wires)} |\n" for name, module, wires in rows
    )


def _lacking() -> str:
    """The rules of the contract that a vendor's device cannot keep or break, each with the reason."""
    return "| driver | test | reason |\n|---|---|---|\n" + "".join(
        f"| {vendor} | `{rule}` | {reason} |\n"
        for vendor, made in VENDORS.items()
        for rule, reason in sorted(made.lacks.items())
    )
