"""Attaching, leaving and limits of the arm driver; the judge is what the simulated controller received and did."""

from contextlib import ExitStack

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import FAR, SLOW, ArmRig, answers, arm_rig, free_rig
from tests.unit.drivers.attached_arm import AT_HOME, attached
from tests.unit.drivers.conftest import Outcome, written_now
from trade import errors
from trade_drivers.vendors.ur import identify
from trade_hil_sim import Absent, Arm, BrownOut, Replug, Unplug, UrBus, instructions, motion_writes
from trade_hil_sim.ur._kinematics import pose_between

pytestmark = pytest.mark.realtime

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
__all__ = ["arm_rig", "free_rig"]

NEAR = [0.6, *AT_HOME[1:]]


def elsewhere(rig: ArmRig) -> str:
    """The controller as another host reaches it: by another text for its address."""
    first, second, third, fourth = map(int, str(rig.sim.port).split("."))
    return f"{first}.{second}.{third * 256 + fourth}"


def test_S19_shutdown_while_moving_stops_first_and_the_arm_holds(rig: ArmRig) -> None:
    moving = rig.set_off()
    mark = written_now()
    rig.robot.close()
    assert isinstance(moving.wait().error, errors.MotionStopped)
    rig.comes_to_rest()
    wait_until(lambda: rig.truth.program == "", "its program has ended")
    assert not rig.moves(mark)
    assert (rig.truth.robot_mode, rig.truth.safety_mode) == ("RUNNING", "NORMAL")


def test_S20_a_second_driver_is_refused_and_the_arm_continues(rig: ArmRig) -> None:
    moving = Outcome(lambda: rig.arm.move_joints(NEAR, SLOW))
    wait_until(lambda: moving.error or rig.base_rad > 0.05, "it is under way")
    mark = written_now()
    for host, why in ((rig.sim.port, "another driver of this host has it: process"), (elsewhere(rig), "has control")):
        with pytest.raises(errors.ConfigurationError, match=why):
            attached(rig.undo, host)
    assert not rig.moves(mark)
    assert not [entry for entry in instructions(rig.log, since=mark) if entry.name == "stop"]
    assert moving.wait().result == pytest.approx(NEAR, abs=0.01)


def test_a_controller_that_does_not_answer_is_absent() -> None:
    with ExitStack() as undo, pytest.raises(errors.DeviceAbsent, match="is it switched on"):
        attached(undo, "127.99.99.99")


def test_S20_of_two_drivers_of_an_arm_at_rest_one_gets_control(rig: ArmRig) -> None:
    second = attached(rig.undo, elsewhere(rig)).arm("right")
    rig.arm.move_joints([0.05, *AT_HOME[1:]])
    mark = written_now()
    with pytest.raises(errors.DeviceFault, match="control was not granted"):
        second.move_joints(AT_HOME)
    assert not rig.moves(mark)


BESIDE = {
    "dashboard": "dashboard server (port 29999)",
    "rtde": "RTDE (port 30004)",
    "script": "script port (port 30003)",
}


@pytest.mark.parametrize("lacks", [["dashboard"], ["rtde"], ["script"], ["rtde", "script"]])
def test_a_service_that_the_controller_lacks_is_named_and_the_others_are_said_to_answer(lacks: list[str]) -> None:
    with ExitStack() as undo:
        sim = undo.enter_context(UrBus(Arm(name="right"), name="ur", lacks=lacks))
        with pytest.raises(errors.ConfigurationError, match=r"bus\.ur\.host") as wrong:
            attached(undo, sim.port)
        before, _, after = str(wrong.value).partition("but it has ")
        for name, said in BESIDE.items():
            assert said in (before if name in lacks else after)
            assert said not in (after if name in lacks else before)
        assert "is it switched on" not in before + after
        assert ("PolyScope X" in after) is ("dashboard" in lacks)
        assert not motion_writes(sim.log.entries)
        assert not instructions(sim.log.entries, "upload")


def test_a_controller_without_any_service_may_be_off_or_elsewhere() -> None:
    with ExitStack() as undo:
        sim = undo.enter_context(UrBus(Arm(name="right"), name="ur", lacks=["dashboard", "rtde", "script"]))
        with pytest.raises(errors.ConfigurationError, match="is it switched on, and is this its address"):
            attached(undo, sim.port)


def test_a_scan_of_a_controller_without_dashboard_names_it() -> None:
    with (
        UrBus(Arm(name="right"), name="ur", lacks=["dashboard"]) as sim,
        pytest.raises(errors.ConfigurationError, match=r"no dashboard server \(port 29999\).*but it has RTDE"),
    ):
        identify(sim.port)


def _narrowed(rig: ArmRig, joint: int, high: float) -> None:
    rig.arm._limb.arm.max_rad[joint] = high  # type: ignore[attr-defined]


def test_S22_what_is_outside_of_the_limits_is_refused_and_nothing_is_sent(rig: ArmRig) -> None:
    limits = rig.arm.limits()
    beyond = [limits.joints[0].max_rad + 0.01, *AT_HOME[1:]]
    for refused in (
        lambda: rig.arm.move_joints(beyond),
        lambda: rig.arm.servo(beyond),
        lambda: rig.arm.move_joints(AT_HOME, limits.joints[0].max_speed_rad_s * 1.01),
        lambda: rig.arm.move_line(rig.arm.state().pose, limits.max_speed_m_s * 1.01),
    ):
        with pytest.raises(errors.LimitExceeded):
            refused()
    assert not rig.moves()
    assert not instructions(rig.log, "upload")


def test_S22_a_move_back_inside_is_allowed_from_outside(rig: ArmRig) -> None:
    _narrowed(rig, 1, AT_HOME[1] - 0.2)
    with pytest.raises(errors.LimitExceeded):
        rig.arm.move_joints(AT_HOME)
    goal = [AT_HOME[0], AT_HOME[1] - 0.3, *AT_HOME[2:]]
    assert rig.arm.move_joints(goal)[1] == pytest.approx(goal[1], abs=0.01)


def test_S22_a_line_on_which_a_joint_would_leave_its_range_is_refused_before_it_begins(rig: ArmRig) -> None:
    _narrowed(rig, 1, AT_HOME[1] + 0.1)
    pose = rig.arm.state().pose
    with pytest.raises(errors.LimitExceeded, match="shoulder on the line"):
        rig.arm.move_line([*pose[:2], pose[2] - 0.4, *pose[3:]], 0.1)
    assert not rig.moves()
    assert rig.arm.move_line([*pose[:2], pose[2] - 0.02, *pose[3:]], 0.1)[2] == pytest.approx(pose[2] - 0.02, abs=0.002)


def test_S22_a_line_that_leaves_a_range_between_its_ends_is_refused(rig: ArmRig) -> None:
    rig.arm.move_joints([0.5, *AT_HOME[1:]])
    start = rig.arm.state()
    rig.arm.move_joints([-0.5, *AT_HOME[1:]])
    middle = rig.arm._limb.arm.min_rad  # type: ignore[attr-defined]
    shoulder = _shoulders_on_the_way(rig, start.pose)
    assert min(shoulder) < shoulder[-1] - 0.05
    middle[1] = (min(shoulder) + min(shoulder[0], shoulder[-1])) / 2
    mark = written_now()
    with pytest.raises(errors.LimitExceeded, match="shoulder on the line"):
        rig.arm.move_line(start.pose, 0.1)
    assert not rig.moves(mark)


def _shoulders_on_the_way(rig: ArmRig, goal: list[float]) -> list[float]:
    """What the shoulder does on a line, by the simulator's geometry."""
    arm = rig.sim.arm
    near, found = arm.q, []
    for k in range(21):
        angles = arm.joints_for(pose_between(arm.pose(), goal, k / 20), near)
        assert angles is not None
        near = angles
        found.append(angles[1])
    return found


def test_S22_a_line_that_leads_out_of_reach_is_refused_before_it_begins(rig: ArmRig) -> None:
    pose = rig.arm.state().pose
    with pytest.raises(errors.InvalidArgument, match="out of reach"):
        rig.arm.move_line([pose[0] - 1.5, *pose[1:]])
    assert not rig.moves()
    assert rig.arm.safety_state() == "normal"
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("how", ["move_joints", "move_line", "servo"])
def test_S22_a_joint_that_is_measured_outside_its_range_is_stopped_by_the_bus_thread(rig: ArmRig, how: str) -> None:
    pose = rig.arm.state().pose
    go = {
        "move_joints": lambda: rig.arm.move_joints(FAR, SLOW),
        "move_line": lambda: rig.arm.move_line([pose[0], pose[1] - 0.5, *pose[2:]], 0.1),
        "servo": lambda: [rig.arm.servo(FAR, 1.0) for _ in range(1000)],
    }[how]
    moving = Outcome(go)
    wait_until(lambda: moving.error or abs(rig.base_rad) > 0.05, "it is under way")
    high, low = rig.base_rad + 0.1, rig.base_rad - 0.1
    rig.arm._limb.arm.max_rad[0], rig.arm._limb.arm.min_rad[0] = high, low  # type: ignore[attr-defined]
    assert isinstance(moving.wait().error, errors.LimitExceeded)
    wait_until(lambda: not rig.moving, "it is at rest")
    assert low - 0.4 < rig.base_rad < high + 0.4


def test_S18_attaching_uploads_and_moves_nothing(rig: ArmRig) -> None:
    assert not rig.moves()
    assert not instructions(rig.log, "upload")
    asked = {e.detail.partition(" -> ")[0] for e in instructions(rig.log, "dashboard")}
    assert asked == {"robotmode", "get robot model"}


def test_S18_an_arm_found_moving_is_stopped(free: ArmRig) -> None:
    free.sim._in_thread(free.sim._program.play)
    wait_until(lambda: free.moving, "its own program moves it")
    free.attach()
    wait_until(lambda: not free.moving, "it is at rest")
    assert not free.moves()


@pytest.mark.parametrize("how", ["cable", "reboot", "silence"])
def test_S18_a_controller_that_comes_back_is_read_and_not_commanded(rig: ArmRig, how: str) -> None:
    moving = rig.set_off()
    rig.sim.do({"cable": Unplug(), "reboot": BrownOut(), "silence": Absent()}[how])
    assert isinstance(moving.wait().error, errors.DeviceSilent | errors.DeviceFault)
    wait_until(lambda: not rig.moving, "it is at rest")
    mark = written_now()
    if how == "cable":
        rig.sim.do(Replug())
    if how == "silence":
        rig.sim.do(Absent(on=False))
    wait_until(lambda: answers(rig.arm, mark), "it is read again")
    assert not rig.moves(mark)
    assert rig.arm.state().enabled == (how != "reboot")


def test_S18_power_and_brakes_are_switched_on_request_only(rig: ArmRig) -> None:
    mark = written_now()
    rig.sim.do(BrownOut())
    wait_until(lambda: answers(rig.arm, mark) and not rig.arm.state().powered, "it is read again, without power")
    with pytest.raises(errors.DeviceFault, match="power_on"):
        rig.arm.move_joints(FAR)
    with pytest.raises(errors.DeviceFault, match="power is off"):
        rig.arm.release_brakes()
    rig.arm.power_on()
    assert rig.arm.state().powered
    with pytest.raises(errors.DeviceFault, match="release_brakes"):
        rig.arm.move_joints(FAR)
    rig.arm.release_brakes()
    assert rig.arm.move_joints([0.1, *AT_HOME[1:]])[0] == pytest.approx(0.1, abs=0.01)
