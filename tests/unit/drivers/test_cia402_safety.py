"""The rules of motion on a CAN bus, judged on frames: the numbers are those of docs/safety.md."""

from collections.abc import Callable

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import HALT, HIP, PATIENT, Leg, leg, rig, turned_by_another
from trade import Container, where
from trade.errors import DeviceFault

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]

QUICK_STOP = 0x02
"""Of bits 1, 2 and 7 of the controlword only the first (CiA 402-2, device control commands)."""


@pytest.mark.realtime
def test_S01_a_search_for_home_that_does_not_end_in_time_is_halted_before_its_deadline(
    rig: Leg, start_container: Callable[..., Container]
) -> None:
    rig.configure(PATIENT)
    rig.plug()
    driver = start_container("driver")
    with rig.attach(register=driver.register, deregister=driver.deregister) as robot:
        robot.motor("leg.hip").enable()
        search = start_container("planner").find(where(name="home", group="rosie.leg.hip"), wait_s=20)
        with pytest.raises(DeviceFault, match="has not found its home in time"):
            search.with_(deadline_s=1.5)(34, 0.01)
        began = rig.wait_for("motion_started", HIP).t
        assert any(word & HALT or word & 0x86 == QUICK_STOP for word in rig.controlwords(HIP, began))


def test_a_halted_drive_does_not_continue_to_its_old_goal_when_it_is_moved_again(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    moving = Outcome(lambda: hip.move_to(0.9, 0.3))
    leg.wait_for("motion_started", HIP)
    hip.stop()
    moving.wait()
    rest = hip.state().position_rad
    mark = written_now()
    hip.enable()
    assert hip.state().position_rad == pytest.approx(rest, abs=0.01)
    assert not leg.events("motion_started", HIP, mark)
    hip.move_to(rest - 0.1)
    assert (
        max(e.position_rad for e in leg.log if e.device_id == HIP and e.t > mark and e.position_rad is not None)
        < rest + 0.01
    )


def test_S18_a_moving_drive_without_an_owner_is_stopped_and_left_enabled(leg: Leg) -> None:
    started = turned_by_another(leg, 5000)
    robot = leg.attach()
    rest = leg.wait_for("at_rest", HIP, started.t)
    assert bytes.fromhex("2b4060000f010000") in [e.data for e in leg.frames("sdo_request", HIP, started.t)]
    assert robot.motor("leg.hip").state().enabled
    assert not leg.events("torque_off", HIP, started.t)
    assert not leg.goals(HIP)
    assert not leg.events("motion_started", HIP, rest.t)


def test_S08_a_joint_with_a_fault_has_stopped_when_it_rests_and_not_before(rig: Leg) -> None:
    """What speaks against moving on says nothing of its being at rest: it brakes for as long as any other."""
    rig.configure(
        ("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 1.0"), ("max_speed_rad_s = 2.0", "max_speed_rad_s = 1.0")
    )
    rig.plug()
    hip = rig.attach().motor("leg.hip")
    axis = hip._axes[0]  # type: ignore[attr-defined]
    moving = Outcome(lambda: hip.move_to(0.9, 0.8))
    started = rig.wait_for("motion_started", HIP)
    wait_until(lambda: hip.state().velocity_rad_s > 0.4, "it is on its way")
    axis.latch("it does not take its goal (statusword bit 12)")
    assert isinstance(moving.wait().error, DeviceFault)
    hip.stop()
    assert rig.events("at_rest", HIP, started.t)
    assert rig.controlwords(HIP, started.t)[-1] & HALT
