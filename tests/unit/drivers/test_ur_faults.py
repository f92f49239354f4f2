"""What goes wrong with an arm and its controller, and what is to come of it."""

import threading
from contextlib import ExitStack

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import FAR, SLOW, ArmRig, arm_rig
from tests.unit.drivers.attached_arm import AT_HOME
from tests.unit.drivers.conftest import Outcome
from trade.errors import DeviceError, DeviceFault, MotionStopped, ToleranceExceeded
from trade_drivers import Tolerances, Trajectory, TrajectoryPoint
from trade_hil_sim import Arm as SimArm
from trade_hil_sim import HardwareFault, Heal, Jam

pytestmark = pytest.mark.realtime

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")


__all__ = ["arm_rig"]


def test_a_protective_stop_cannot_be_unlocked_at_once() -> None:
    with ExitStack() as undo:
        rig = ArmRig(undo, SimArm(name="right", unlock_s=3600.0))
        rig.attach()
        rig.sim.do(HardwareFault(bits=3))
        wait_until(lambda: rig.arm.safety_state() == "protective stop", "it is reported")
        with pytest.raises(DeviceFault, match="Cannot unlock"):
            rig.arm.unlock_protective_stop()


def test_a_blocked_arm_leaves_its_trajectory_and_the_caller_hears_of_it(rig: ArmRig) -> None:
    joints = [limit.name for limit in rig.arm.limits().joints]
    way = Trajectory(
        joints=joints,
        points=[
            TrajectoryPoint(time_from_start_s=time, positions_rad=[angle, *AT_HOME[1:]])
            for time, angle in ((0.0, 0.0), (3.0, 1.0))
        ],
    )
    errors: list[BaseException] = []

    def go() -> None:
        try:
            rig.arm.follow(way, Tolerances(path_rad=0.05))
        except DeviceError as error:
            errors.append(error)

    follower = threading.Thread(target=go)
    follower.start()
    wait_until(lambda: rig.base_rad > 0.05, "it is under way")
    rig.sim.do(Jam())
    follower.join(30)
    [error] = errors
    assert "slider" not in str(error)
    rig.sim.do(Heal())
    rig.comes_to_rest()


def to(base_rad: float, duration_s: float, rig: ArmRig) -> Trajectory:
    """The base alone, from home."""
    return Trajectory(
        joints=[limit.name for limit in rig.arm.limits().joints],
        points=[
            TrajectoryPoint(time_from_start_s=at_s, positions_rad=[angle, *AT_HOME[1:]], velocities_rad_s=[0.0] * 6)
            for at_s, angle in ((0.0, 0.0), (duration_s, base_rad))
        ],
    )


def test_the_error_of_a_trajectory_that_the_speed_slider_slows_names_the_slider(rig: ArmRig) -> None:
    rig.arm.set_speed_scaling(0.1)
    wait_until(lambda: rig.arm.state().speed_scaling == 0.1, "the slider is set")
    with pytest.raises(ToleranceExceeded) as off:
        rig.arm.follow(to(1.0, 2.5, rig), Tolerances(path_rad=0.05))
    assert "Probably its speed slider is at 10 %: undo that" in str(off.value)
    assert "blocked" not in str(off.value)
    rig.comes_to_rest()


def test_a_trajectory_that_keeps_up_at_a_low_speed_slider_arrives(rig: ArmRig) -> None:
    rig.arm.set_speed_scaling(0.5)
    wait_until(lambda: rig.arm.state().speed_scaling == 0.5, "the slider is set")
    assert rig.arm.follow(to(0.3, 1.5, rig))[0] == pytest.approx(0.3, abs=0.02)


def test_a_move_that_the_speed_slider_slows_past_its_deadline_names_the_slider(rig: ArmRig) -> None:
    rig.arm.set_speed_scaling(0.1)
    wait_until(lambda: rig.arm.state().speed_scaling == 0.1, "the slider is set")
    late = Outcome(lambda: rig.arm.move_joints([1.0, *AT_HOME[1:]]), deadline_s=3.0).wait()
    assert isinstance(late.error, MotionStopped)
    assert "reached its deadline; its speed slider is at 10 %" in str(late.error)
    rig.comes_to_rest()


def test_a_move_that_the_speed_slider_holds_up_names_the_slider(rig: ArmRig) -> None:
    moving = rig.set_off()
    rig.sim.arm.speed_fraction = 0.0  # at the teach pendant
    error = moving.wait().error
    assert isinstance(error, DeviceFault)
    assert "it makes no progress; its speed slider is at 0 %" in str(error)
    rig.comes_to_rest()


def test_a_move_that_reaches_its_deadline_at_full_speed_names_no_slider(rig: ArmRig) -> None:
    late = Outcome(lambda: rig.arm.move_joints(FAR, SLOW), deadline_s=2.0).wait()
    assert isinstance(late.error, MotionStopped)
    assert "slider" not in str(late.error)


def test_another_move_takes_over_and_the_one_before_hears_of_it(rig: ArmRig) -> None:
    moving = rig.set_off()
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)
    assert isinstance(moving.wait().error, MotionStopped)
