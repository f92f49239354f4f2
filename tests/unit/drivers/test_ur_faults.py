"""What goes wrong with an arm and its controller, and what is to come of it."""

import threading
from contextlib import ExitStack

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import ArmRig, arm_rig
from tests.unit.drivers.attached_arm import AT_HOME
from trade.errors import DeviceError, DeviceFault, MotionStopped
from trade_drivers import Tolerances, Trajectory, TrajectoryPoint
from trade_hil_sim import Arm as SimArm
from trade_hil_sim import HardwareFault, Heal, Jam

pytestmark = pytest.mark.slow

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
    assert errors
    rig.sim.do(Heal())
    rig.comes_to_rest()


def test_another_move_takes_over_and_the_one_before_hears_of_it(rig: ArmRig) -> None:
    moving = rig.set_off()
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)
    assert isinstance(moving.wait().error, MotionStopped)
