"""S23 over every vendor: a device is compared with the robot file before the first motion and after a loss of power.

The simulator's log is the judge: a refusal has both numbers, and nothing is sent that moves or switches torque on.
"""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.contract.rigs.differences import DIFFERENCES, QUESTIONS, Difference
from tests.contract.rigs.joints import FIRST, JointRig
from tests.contract.rigs.vendors import RIGS
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from trade.errors import ConfigurationError, DeviceFault

PAGE = (Path(__file__).parents[2] / "docs" / "drivers.md").read_text(encoding="utf-8")
TABLE = PAGE.partition("**What else differs.**")[2].partition("\n## ")[0]


def test_S23_every_vendor_has_each_question_or_a_reason_that_is_in_the_page() -> None:
    rows = {row.split("|")[1].strip().lower(): row for row in TABLE.splitlines() if row.startswith("| ")}
    assert set(DIFFERENCES) == set(RIGS)
    for vendor, questions in DIFFERENCES.items():
        assert tuple(questions) == QUESTIONS, vendor
        for question, reason in questions.items():
            if isinstance(reason, str):
                assert reason in rows[vendor.replace("cia402", "cia 402")], (vendor, question)


def prepared(rig: JointRig, difference: Difference) -> None:
    """The device is plugged in and has said what the file says."""
    rig.configure(*difference.changes)
    rig.place(difference.at_rad)
    rig.attach_to_ask()


def differs(rig: JointRig, difference: Difference) -> float:
    """It loses its power, and says something else; since when nothing may be sent."""
    difference.make(rig.bench.sim)
    rig.bench.sim.do(difference.loss)
    difference.make(rig.bench.sim)
    return written_now()


def refused(rig: JointRig, act: Callable[[], object], since: float, *says: str) -> None:
    with pytest.raises((ConfigurationError, DeviceFault)) as refusal:
        act()
    for part in says:
        assert part in str(refusal.value)
    assert not rig.commanded(since)
    assert not rig.events("motion_started", since)
    assert not rig.events("torque_on", since)
    assert not rig.truth(FIRST).torque


def test_S23_what_differs_is_refused_with_both_numbers_before_anything_is_sent(
    rig: JointRig, difference: Difference
) -> None:
    prepared(rig, difference)
    rig.robot.close()
    since = differs(rig, difference)

    def start() -> None:
        rig.attach_to_ask()
        rig.ready()

    refused(rig, start, since, *difference.says)


def test_S23_what_differs_after_a_loss_of_power_is_a_fault_before_anything_is_sent(
    rig: JointRig, difference: Difference
) -> None:
    prepared(rig, difference)
    rig.ready()
    lost = differs(rig, difference)
    wait_until(rig.noticed, "it is noticed")
    since = written_now()
    refused(rig, rig.device.enable, since, *difference.says)
    refused(rig, lambda: rig.device.move_to(0.1), since)
    refused(rig, lambda: rig.device.set_velocity(0.1), since)
    assert not rig.events("motion_started", lost)
    assert not rig.events("torque_on", lost)


def test_S23_what_does_not_differ_is_accepted_also_after_a_loss_of_power(rig: JointRig, difference: Difference) -> None:
    """The control: the same loss, with the zero kept."""
    prepared(rig, difference)
    rig.ready()
    rig.bench.sim.do(type(difference.loss)(ids=(FIRST,)))
    wait_until(rig.noticed, "it is noticed")
    rig.device.enable()
    assert rig.device.move_to(difference.at_rad - 0.1) == pytest.approx(difference.at_rad - 0.1, abs=0.03)
