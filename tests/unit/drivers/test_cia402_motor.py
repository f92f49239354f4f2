"""What a drive and a group of them do on the bus, beyond their contracts: its frames say what was meant."""

import functools
import itertools

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import COUNTS_PER_RAD, GO, HALT, HIP, HOMING, KNEE, PROFILE_POSITION, Leg, leg, only, rig
from trade.errors import ConfigurationError, DeviceFault, InvalidArgument, LimitExceeded, MotionStopped
from trade_drivers import JointGroup, Tolerances, Trajectory, TrajectoryPoint
from trade_drivers.vendors.cia402._homing import Drive

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]


def test_enabling_passes_one_state_after_the_other_and_ends_halted_at_the_current_position(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    mark = written_now()
    hip.enable()
    assert leg.controlwords(HIP, mark)[:3] == [0x06, 0x07, 0x10F]
    assert not any(word & GO for word in leg.controlwords(HIP, mark))
    assert {e.data[2:] for e in leg.frames("rpdo1", HIP, mark)} == {bytes(4)}
    assert not leg.controlwords(KNEE, mark)


def test_a_set_point_has_an_edge_and_the_edge_is_taken_back_when_it_was_taken(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    mark = written_now()
    for goal in (0.2, 0.4, 0.1):
        hip.move_to(goal)
    words = leg.controlwords(HIP, mark)
    raised = [not before & GO and word & GO for before, word in itertools.pairwise(words)]
    assert sum(map(bool, raised)) == 3
    assert not any(before & GO and word & GO for before, word in itertools.pairwise(words))
    assert leg.goals(HIP, mark) == [round(goal * COUNTS_PER_RAD) for goal in (0.2, 0.4, 0.1)]


def test_a_group_starts_together_and_arrives_together(leg: Leg) -> None:
    group = leg.attach().group("leg")
    group.enable()
    mark = written_now()
    assert group.move_to([0.8, -0.4]) == pytest.approx([0.8, -0.4], abs=0.01)
    both = [e for e in leg.frames("rpdo1", since=mark) if e.data[0] & GO]
    assert [e.device_id for e in both] == [HIP, KNEE]
    assert not [e for e in leg.frames("sync", since=both[0].t) if e.t < both[1].t]
    started, ended = both[0].t, [leg.wait_for("at_rest", joint, both[1].t).t for joint in (HIP, KNEE)]
    assert ended[0] - started == pytest.approx(ended[1] - started, rel=0.1)


def test_servo_follows_newer_and_newer_goals(leg: Leg) -> None:
    group = leg.attach().group("leg")
    group.enable()
    for step in range(20):
        group.servo([0.01 * step, 0.0], valid_s=0.5)
    wait_until(lambda: leg.goals(HIP)[-1] == round(0.19 * COUNTS_PER_RAD), "the last goal is on the wire")
    assert leg.goals(HIP) == sorted(leg.goals(HIP))


ACKNOWLEDGED = 1 << 12


def through(group: JointGroup, *rows: tuple[float, list[float]]) -> Trajectory:
    points = [TrajectoryPoint(time_from_start_s=time_s, positions_rad=angles) for time_s, angles in rows]
    return Trajectory(joints=group.joints(), points=points)


def shaken(leg: Leg, joint: int, since: float) -> bool:
    """Whether no set-point was raised before the drive had ended the handshake of the one before."""
    word, free = 0, True
    for entry in leg.frames(device_id=joint, since=since):
        if entry.name == "rpdo1":
            word = int.from_bytes(entry.data[:2], "little")
            if word & GO and not free:
                return False
            free = free and not word & GO
        elif entry.name == "tpdo1" and not word & GO and not int.from_bytes(entry.data[:2], "little") & ACKNOWLEDGED:
            free = True
    return True


def test_a_trajectory_is_streamed_at_the_rate_at_which_drives_take_goals(rig: Leg) -> None:
    leg = rig
    leg.plug(prepare=only(PROFILE_POSITION, HOMING))
    group = leg.attach().group("leg")
    group.enable()
    mark = written_now()
    trajectory = through(group, (0.0, [0.0, 0.0]), (0.7, [0.5, 0.2]), (1.4, [-0.2, -0.2]), (2.0, [0.0, 0.0]))
    assert group.follow(trajectory, Tolerances(path_rad=0.5)) == pytest.approx([0.0, 0.0], abs=0.03)
    assert shaken(leg, HIP, mark)
    assert shaken(leg, KNEE, mark)
    goals, cycles = leg.goals(HIP, mark), len(leg.frames("sync", since=mark))
    assert cycles / 5 < len(goals) <= cycles / 2 + 1
    assert max(goals) == pytest.approx(0.5 * COUNTS_PER_RAD, rel=0.1)
    assert len(leg.frames("rpdo2", HIP, mark)) == 1  # its ramps do not change on the way


ROUNDS = 5


def test_a_move_takes_over_from_trajectories_whose_handshakes_alternate(rig: Leg) -> None:
    single = "".join(f'[group.{joint}]\njoints = ["leg.{joint}"]\n' for joint in ("hip", "knee"))
    rig.configure(("[group.leg]", f"{single}[group.leg]"))
    rig.plug(prepare=only(PROFILE_POSITION, HOMING))
    robot = rig.attach()
    hip, knee, both = (robot.group(name) for name in ("hip", "knee", "leg"))
    both.enable()
    mark, taken_over = written_now(), 0
    for _ in range(4 * ROUNDS):
        streams: list[Outcome] = []
        for group, joint in ((hip, HIP), (knee, KNEE)):
            [state] = group.state()
            there = [state.position_rad + 0.3]
            trajectory = through(group, (0.0, [state.position_rad]), (1.5, there))
            since, follow = written_now(), functools.partial(group.follow, trajectory, Tolerances(path_rad=0.5))
            streams.append(Outcome(follow))
            wait_until(
                lambda: len(rig.goals(joint, since)) > 3 or streams[-1].error,  # noqa: B023 - over before the next
                "goals follow each other, or a busy computer held them up",
            )
        assert both.move_to([0.0, 0.0]) == pytest.approx([0.0, 0.0], abs=0.01)
        taken_over += all(isinstance(stream.wait().error, MotionStopped) for stream in streams)
        if taken_over == ROUNDS:
            break
    assert taken_over == ROUNDS
    assert shaken(rig, HIP, mark)
    assert shaken(rig, KNEE, mark)


def test_a_bus_too_slow_for_set_points_refuses_trajectories(rig: Leg) -> None:
    rig.configure(('channel = "can0"', 'channel = "can0"\nrate_hz = 12'))
    rig.plug(prepare=only(PROFILE_POSITION, HOMING))
    group = rig.attach().group("leg")
    mark = written_now()
    with pytest.raises(ConfigurationError, match="rate_hz to 15"):
        group.follow(through(group, (0.0, [0.0, 0.0]), (2.0, [0.1, 0.2])))
    assert not rig.controlwords(HIP, mark)


def test_S04_a_set_point_that_is_not_renewed_ends_in_a_halt(rig: Leg) -> None:
    leg = rig
    leg.plug(prepare=only(PROFILE_POSITION, HOMING))
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    mark = written_now()
    hip.set_velocity(0.5, valid_s=0.2)
    wait_until(lambda: leg.controlwords(HIP, mark) and leg.controlwords(HIP, mark)[-1] & HALT, "it was halted")
    leg.wait_for("at_rest", HIP, mark)
    assert hip.state().position_rad < 0.9


def test_the_frames_of_a_drive_are_mapped_in_the_order_drives_insist_on(leg: Leg) -> None:
    leg.attach()
    writes = [e.data for e in leg.frames("sdo_request", HIP) if e.data[0] & 0xE0 == 0x20]
    places = [(int.from_bytes(data[1:3], "little"), data[3], int.from_bytes(data[4:8], "little")) for data in writes]
    first = [place for place in places if place[0] in {0x1800, 0x1A00}]
    assert first == [
        (0x1800, 1, 0xC0000181),
        (0x1800, 2, 1),
        (0x1A00, 0, 0),
        (0x1A00, 1, 0x60410010),
        (0x1A00, 2, 0x60640020),
        (0x1A00, 3, 0x60770010),
        (0x1A00, 0, 3),
        (0x1800, 1, 0x40000181),
    ]
    assert [place[2] for place in places if place[0] == 0x1400 and place[1] == 2] == [255]


def test_home_takes_where_it_is_for_zero_and_the_next_move_is_in_the_usual_mode(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    assert isinstance(hip, Drive)
    hip.move_to(0.3)
    mark = written_now()
    assert hip.home() == pytest.approx(0.0, abs=0.001)
    assert not leg.events("motion_started", HIP, mark)
    assert hip.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_home_with_a_method_the_drive_does_not_know_is_a_fault_and_moves_nothing(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    assert isinstance(hip, Drive)
    hip.enable()
    mark = written_now()
    with pytest.raises(DeviceFault):
        hip.home(method=36)
    assert not leg.events("motion_started", HIP, mark)


def test_enable_ends_homing_and_the_waiting_call_raises(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    assert isinstance(hip, Drive)
    hip.enable()
    slow = Outcome(lambda: hip.home(34, 0.01))
    leg.wait_for("motion_started", HIP)
    hip.enable()
    assert isinstance(slow.wait().error, MotionStopped)
    assert hip.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_S22_home_too_fast_is_refused(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    assert isinstance(hip, Drive)
    for speed in (2.1, 0.0, -1.0):
        with pytest.raises(LimitExceeded):
            hip.home(37, speed)


def test_S22_the_limits_of_set_points_hold(leg: Leg) -> None:
    robot = leg.attach()
    hip, group = robot.motor("leg.hip"), robot.group("leg")
    mark = written_now()
    with pytest.raises(LimitExceeded):
        hip.set_velocity(2.1)
    with pytest.raises(LimitExceeded):
        group.servo([0.0, 1.1])
    with pytest.raises(InvalidArgument):
        group.servo([float("nan"), 0.0])
    assert not leg.frames("rpdo1", since=mark)
