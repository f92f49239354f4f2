"""What attaching to servos and leaving them writes: nothing that moves. By the numbers of the rules, S18 to S20."""

import time

import pytest

import trade_hil_sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig, is_silent
from trade_hil_sim import DynamixelBus

pytestmark = pytest.mark.virtual_time


def _enable(sim: DynamixelBus) -> None:
    sim.devices[0].write(64, b"\1", time.monotonic())


def test_S18_attaching_to_enabled_servos_writes_no_motion(rig: Rig) -> None:
    rig.plug(prepare=_enable)
    robot = rig.attach()
    assert not rig.moves()
    assert robot.motor("neck.pan").state().enabled
    assert rig.truth(1).watchdog == 15


@pytest.mark.parametrize("noticed", [True, False], ids=["before", "during the shutdown"])
def test_S19_a_joint_that_falls_silent_is_reported_and_keeps_its_watchdog(head: Rig, noticed: bool) -> None:
    robot = head.attach()
    robot.group("head").enable()
    head.sim.do(trade_hil_sim.Mute(ids=(1,)))
    if noticed:
        wait_until(lambda: is_silent(robot, "neck.pan"), "it is silent")
    robot.close()
    assert robot.unseen() == ["rosie.neck.pan"]
    assert head.truth(2).watchdog == 0
    if noticed:
        head.wait_for("watchdog_expired", 1)
