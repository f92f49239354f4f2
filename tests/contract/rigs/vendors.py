"""Every vendor whose driver must keep the safety rules."""

import re
from pathlib import Path

from tests.contract.rigs.base import SafetyRig
from tests.contract.rigs.can_joints import Cia402Rig, DamiaoRig, OdriveRig
from tests.contract.rigs.dynamixel import DynamixelRig
from tests.contract.rigs.feetech import FeetechRig
from tests.contract.rigs.robotiq import RobotiqRig
from tests.contract.rigs.ur import UrRig

RIGS: dict[str, type[SafetyRig]] = {
    "dynamixel": DynamixelRig,
    "feetech": FeetechRig,
    "cia402": Cia402Rig,
    "odrive": OdriveRig,
    "damiao": DamiaoRig,
    "robotiq": RobotiqRig,
    "ur": UrRig,
}

RULES: list[str] = [
    rule
    for module in sorted(Path(__file__).parents[1].glob("test_*.py"))
    for rule in re.findall(r"^def (test_\w+)", module.read_text(encoding="utf-8"), re.MULTILINE)
]


def rules_of(made: type[SafetyRig]) -> set[str]:
    """The rules that a vendor must keep."""
    return {rule for rule in RULES if rule not in made.lacks}
