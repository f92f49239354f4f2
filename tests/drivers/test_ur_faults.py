"""What goes wrong with an arm and its controller, and what is to come of it."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from arms import AT_HOME
from drivers.conftest import written_now
from drivers.test_ur_safety import Rig
from trade.errors import DeviceError, DeviceFault, DeviceSilent, LimitExceeded, MotionStopped
from trade_drivers import Tolerances, Trajectory, TrajectoryPoint
from trade_drivers.ur._dashboard import ask
from trade_hil_sim import Absent, BrownOut, Command, Freeze, Garbage, HardwareFault, Heal, Jam, Mute, Replug, Unplug
from trade_hil_sim import Arm as SimArm
from waiting import wait_until

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")


@pytest.fixture
def rig() -> Iterator[Rig]:
    with ExitStack() as undo:
        yield Rig(undo)


FAULTS: list[tuple[str, Command, type[DeviceError], str, Command]] = [
    ("the states fall silent", Mute(instruction="data"), DeviceSilent, "did not answer", Heal()),
    ("the clock of the controller stands", Freeze(tick=True), DeviceSilent, "did not answer", Heal()),
    ("the network is cut", Absent(), DeviceSilent, "did not answer", Absent(on=False)),
    ("the connections are dropped", Unplug(), DeviceError, "", Replug()),
    ("noise in the stream", Garbage(instruction="data", count=1), DeviceError, "", Heal()),
    ("a reboot", BrownOut(), DeviceError, "", Heal()),
    ("a protective stop", HardwareFault(bits=3), DeviceFault, "protective stop", Heal()),
    ("an emergency stop", HardwareFault(bits=7), DeviceFault, "emergency stop", HardwareFault(bits=1)),
    ("something blocks it", Jam(), DeviceFault, "protective stop", Heal()),
]


@pytest.mark.parametrize(("name", "fault", "error", "says", "cure"), FAULTS, ids=[fault[0] for fault in FAULTS])
def test_a_fault_while_moving_ends_the_move_and_nothing_moves_when_it_is_over(
    rig: Rig, name: str, fault: Command, error: type[DeviceError], says: str, cure: Command
) -> None:
    moving = rig.set_off()
    rig.sim.do(fault)
    ended = moving.wait().error
    assert isinstance(ended, error), ended
    assert says in str(ended)
    rig.stands()
    stood, mark = rig.base_rad, written_now()
    rig.sim.do(cure)
    wait_until(lambda: _measured(rig, mark), "it is read again")
    later = written_now() + 0.3
    wait_until(lambda: _measured(rig, later), "time has passed")
    assert rig.base_rad == stood
    assert not rig.moves(mark)


@pytest.mark.parametrize("cause", [HardwareFault(bits=3), Jam()], ids=["ordered", "blocked"])
def test_a_protective_stop_is_unlocked_on_request_and_then_it_can_be_moved(rig: Rig, cause: Command) -> None:
    moving = rig.set_off()
    rig.sim.do(cause)
    assert "unlock_protective_stop" in str(moving.wait().error)
    rig.sim.do(Heal())
    rig.stands()
    wait_until(lambda: rig.arm.safety_state() == "protective stop", "it is told")
    with pytest.raises(DeviceFault, match="protective stop"):
        rig.arm.move_joints(AT_HOME)
    wait_until(lambda: _unlocked(rig), "the controller takes it")
    assert rig.arm.move_joints(AT_HOME)[0] == pytest.approx(0.0, abs=0.01)


def test_a_protective_stop_cannot_be_unlocked_at_once() -> None:
    with ExitStack() as undo:
        rig = Rig(undo, arm=SimArm(name="right", unlock_s=3600.0))
        rig.sim.do(HardwareFault(bits=3))
        wait_until(lambda: rig.arm.safety_state() == "protective stop", "it is told")
        with pytest.raises(DeviceFault, match="Cannot unlock"):
            rig.arm.unlock_protective_stop()


def test_in_silence_no_state_is_handed_out(rig: Rig) -> None:
    rig.sim.do(Freeze(tick=True))
    wait_until(lambda: _silent(rig), "the last state is too old")
    with pytest.raises(DeviceSilent):
        rig.arm.move_joints(AT_HOME)
    assert not rig.moves()


def test_a_controller_that_is_not_in_remote_control_says_so_when_it_is_commanded() -> None:
    with ExitStack() as undo:
        rig = Rig(undo)
        rig.sim._dashboard.remote = False
        with pytest.raises(DeviceFault, match="control was not granted"):
            rig.arm.move_joints([0.1, *AT_HOME[1:]])
        assert rig.base_rad == 0.0


def test_a_line_that_leads_out_of_reach_is_a_fault_and_the_arm_stands(rig: Rig) -> None:
    pose = rig.arm.state().pose
    with pytest.raises(DeviceFault):
        rig.arm.move_line([pose[0] - 1.5, *pose[1:]])
    assert not rig.moving


def test_a_line_on_which_a_joint_leaves_its_range_ends_there(rig: Rig) -> None:
    rig.robot.arm("right").limits()
    limb = rig.arm._limb  # type: ignore[attr-defined]
    limb.arm.max_rad[1] = AT_HOME[1] + 0.1
    pose = rig.arm.state().pose
    with pytest.raises(LimitExceeded, match="shoulder on the line"):
        rig.arm.move_line([*pose[:2], pose[2] - 0.4, *pose[3:]], 0.1)
    wait_until(lambda: not rig.moving, "it stands")
    assert rig.sim.state().arms[0].positions_rad[1] < AT_HOME[1] + 0.3


def test_a_blocked_arm_leaves_its_trajectory_and_the_caller_hears_of_it(rig: Rig) -> None:
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
    rig.stands()


def test_a_program_that_somebody_else_ends_is_a_fault_and_the_next_move_takes_control_again(rig: Rig) -> None:
    moving = rig.set_off()
    assert ask(rig.sim.port, "stop", 20.0) == "Stopped"
    assert isinstance(moving.wait().error, DeviceFault)
    rig.stands()
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)


def test_another_move_takes_over_and_the_one_before_hears_of_it(rig: Rig) -> None:
    moving = rig.set_off()
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)
    assert isinstance(moving.wait().error, MotionStopped)


def _measured(rig: Rig, since: float) -> bool:
    try:
        return rig.arm.state().measured_at > since
    except DeviceSilent:
        return False


def _silent(rig: Rig) -> bool:
    try:
        rig.arm.state()
    except DeviceSilent:
        return True
    return False


def _unlocked(rig: Rig) -> bool:
    try:
        rig.arm.unlock_protective_stop()
    except DeviceFault as refused:
        assert "Cannot unlock" in str(refused)
        return False
    return True
