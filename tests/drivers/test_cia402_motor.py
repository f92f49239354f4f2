"""A drive is a motor like any other, and two of them a group; what its frames say is what was meant."""

import itertools

import pytest

from drivers.conftest import written_now
from drivers.legs import COUNTS_PER_RAD, GO, HALT, HIP, KNEE, Leg, leg, rig
from drivers.motor_contract import MotorContract
from trade.errors import DeviceFault, InvalidArgument, LimitExceeded
from trade_drivers import Motor
from trade_drivers.cia402._motor import Drive
from waiting import wait_until

__all__ = ["leg", "rig"]


class TestDriveIsAMotor(MotorContract):
    @pytest.fixture
    def motor(self, leg: Leg) -> Motor:
        return leg.attach().motor("leg.hip")


class TestReversedDriveIsAMotor(MotorContract):
    @pytest.fixture
    def motor(self, leg: Leg) -> Motor:
        return leg.attach().motor("leg.knee")


def test_the_way_to_enabled_is_one_state_after_the_other_and_ends_halted_where_it_is(leg: Leg) -> None:
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


def test_S04_a_set_point_that_is_not_renewed_ends_in_a_halt(leg: Leg) -> None:
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
