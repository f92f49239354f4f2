"""The safety rules, by their numbers, over every vendor; the judge is what the simulated devices received and did.

A vendor that a rule does not apply to names it in its rig, with the reason.
"""

import signal
import time
from typing import Any

import pytest

from tests.contract.rigs.base import SafetyRig, answers
from tests.contract.rigs.joints import FIRST, SECOND, JointRig
from tests.contract.rigs.vendors import RIGS, RULES
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, call, sleep_past, written_now
from tests.unit.drivers.gate import Gate
from trade.errors import (
    DeadlineExceeded,
    DeviceError,
    DeviceFault,
    InvalidArgument,
    LimitExceeded,
    LockedByOther,
    MotionStopped,
    TradeError,
)
from trade_hil_sim import Mute, Replug, Unplug


def pass_s(seconds: float) -> None:
    sleep_past(time.monotonic_ns() + round(seconds * 1e9))


def test_every_rule_that_a_vendor_lacks_is_a_rule_and_has_a_reason() -> None:
    for vendor, made in RIGS.items():
        assert set(made.lacks) <= set(RULES), vendor
        assert all(made.lacks.values()), vendor


# --- S01 late is never


def test_S01_a_command_that_expires_while_the_bus_is_held_up_is_never_written(rig: SafetyRig, gate: Gate) -> None:
    rig.patient()
    rig.attach_to_command(healthy=gate)
    gate.hold_up()
    mark = written_now()
    late = [Outcome(command, deadline_s=0.05) for command in rig.queued()]
    with call(0.1) as expires_ns:
        sleep_past(expires_ns)
    gate.release()
    for command in late:
        assert isinstance(command.wait().error, DeadlineExceeded)
    assert not rig.commanded(mark)


def test_S01_a_move_of_an_enabled_joint_that_expires_meanwhile_is_never_written(rig: SafetyRig, gate: Gate) -> None:
    rig.patient()
    rig.attach(healthy=gate)
    rig.ready()
    gate.hold_up()
    mark = written_now()
    late = [Outcome(command, deadline_s=0.05) for command in rig.queued_when_ready()]
    with call(0.1) as expires_ns:
        sleep_past(expires_ns)
    gate.release()
    for command in late:
        assert isinstance(command.wait().error, DeadlineExceeded)
    assert not rig.ordered(mark)
    assert not rig.events("motion_started", mark)


def test_S01_a_plain_call_waits_one_second_for_its_turn_at_most(rig: SafetyRig, gate: Gate) -> None:
    rig.patient()
    rig.attach_to_command(healthy=gate)
    gate.hold_up()
    mark = written_now()
    late = Outcome(rig.move)
    with call(1.05) as expires_ns:
        sleep_past(expires_ns)
    gate.release()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not rig.commanded(mark)


# --- S06 the last resort is in the device


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill -9", "SIGSTOP"])
def test_S06_a_driver_process_that_dies_or_freezes_while_moving_is_stopped_by_the_device(
    rig: SafetyRig, number: int
) -> None:
    driver = rig.driver_process()
    rig.under_way()
    driver.signal(number)
    rig.last_resort(written_now())
    rig.rests()


@pytest.mark.realtime
def test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why(rig: JointRig) -> None:
    driver = rig.driver_process()
    rig.under_way()
    mark = written_now()
    driver.signal(signal.SIGSTOP)
    stopped = rig.stopped_by_itself(mark)
    rig.rests()
    rested = rig.truth().position_rad
    pass_s(1.0)
    driver.signal(signal.SIGCONT)
    said = driver.line()
    assert "DeviceFault" in said or "DeviceSilent" in said
    assert all(part in said for part in rig.says_on_waking), said
    assert rig.truth().position_rad == pytest.approx(rested, abs=0.002)
    assert not rig.sent_on_waking(stopped)
    for event in ("motion_started", "torque_on", "watchdog_cleared"):
        assert not rig.events(event, stopped)


class Health:
    """A health check that fails in one of two ways."""

    sick = ""

    def __call__(self) -> bool:
        if self.sick == "raises":
            raise RuntimeError("broken")
        return not self.sick


@pytest.mark.parametrize("how", ["says no", "raises"])
def test_S06_an_unhealthy_process_holds_once_and_falls_silent(rig: SafetyRig, how: str) -> None:
    health = Health()
    rig.attach(healthy=health)
    moving = rig.set_off()
    health.sick = how
    assert moving.wait().error is not None
    rig.rests()
    since = rig.falls_silent()
    for command in rig.commands():
        with pytest.raises(DeviceError, match="not healthy"):
            command()
    assert not rig.heard(since)


def test_S06_a_defect_in_the_bus_thread_silences_the_bus_and_raises_for_every_caller(
    rig: SafetyRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.attach()
    moving = rig.set_off()

    def defect() -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(rig.exchange, "cycle", defect)
    assert "a defect" in str(moving.wait().error)
    if rig.stops_without_driver:
        rig.rests()
    for act in (rig.device.stop, *rig.commands()):
        with pytest.raises(DeviceError):
            act()
    wait_until(lambda: not answers(rig.device.state), "what was measured is too old")


def test_S06_every_enabled_joint_has_its_watchdog_armed(rig: Any) -> None:
    rig.attach()
    rig.robot.group(rig.group).enable()
    assert rig.armed()


# --- S07, S08 stop


def test_S07_a_stop_gets_through_while_another_joint_is_silent(rig: JointRig) -> None:
    rig.attach()
    moving = rig.set_off()
    rig.bench.sim.do(Mute(ids=(SECOND,)))
    pass_s(0.02)
    asked = written_now()
    rig.device.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    rig.judge_stop(asked)
    rig.rests()
    assert rig.truth().torque


def test_S07_a_stop_is_the_first_thing_on_a_bus_that_was_held_up(rig: SafetyRig, gate: Gate) -> None:
    rig.patient()
    rig.attach(healthy=gate)
    moving = rig.set_off()
    gate.hold_up()
    mark = written_now()
    waiting = [Outcome(rig.move) for _ in range(3)]
    wait_until(lambda: len(rig.exchange._inbox) == 3, "they wait")
    stop = Outcome(rig.device.stop)
    wait_until(lambda: rig.exchange._stops, "the stop is queued")
    gate.release()
    assert stop.wait().error is None
    assert all(one.wait().error is not None for one in (moving, *waiting))
    rig.rests()
    assert not rig.sent_away(mark, within_rad=0.2)


def test_S08_a_command_admitted_before_a_stop_is_dropped_after_it(rig: SafetyRig, gate: Gate) -> None:
    rig.patient()
    rig.attach(healthy=gate)
    rig.ready()
    gate.hold_up()
    mark = written_now()
    moving = Outcome(rig.move)
    wait_until(lambda: rig.exchange._inbox, "the move is admitted")
    stopping = Outcome(rig.device.stop)
    wait_until(lambda: rig.exchange._stops, "the stop is admitted")
    gate.release()
    assert isinstance(moving.wait().error, MotionStopped)
    assert stopping.wait().error is None
    assert not rig.sent_away(mark)
    assert not rig.events("motion_started", mark)


def test_S08_a_stop_holds_the_joint_where_it_is_and_sends_no_further_set_points(rig: SafetyRig) -> None:
    rig.attach()
    moving = rig.set_off()
    rig.device.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    assert rig.at_rest()
    rig.rests()
    stopped, rest = written_now(), rig.travelled()
    pass_s(0.3)
    assert not rig.sent_away(stopped)
    assert rig.travelled() == pytest.approx(rest, abs=0.002)


def test_S08_a_stop_halts_every_joint_of_a_group_that_moves(rig: JointRig) -> None:
    rig.attach()
    group = rig.robot.group(rig.group)
    group.enable()
    mark = written_now()
    moving = Outcome(lambda: group.move_to([0.5, 0.5], 0.3))
    started = rig.bench.wait_for("motion_started", SECOND, mark)
    rig.device.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    for joint in (FIRST, SECOND):
        rig.bench.wait_for("at_rest", joint, started.t)
        assert rig.truth(joint).position_rad < 0.45


# --- S11 locks


class Lost:
    """A permit whose lock is another's by the time it is looked at."""

    def __init__(self, good_for: int) -> None:
        self.left = good_for

    def gate(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise LockedByOther(resources=["rosie.leg.hip"], owner="another client", purpose="walk")


@pytest.mark.parametrize("looks", [0, 2])
def test_S11_a_command_whose_lock_is_gone_is_kept_off_the_wire(rig: JointRig, looks: int) -> None:
    rig.attach()
    mark = written_now()
    move = rig.forged(0.5, Lost(looks))
    with pytest.raises(LockedByOther):
        move.wait(lambda: True)
    assert not rig.sent_away(mark)
    assert not rig.events("motion_started", mark)


# --- S18, S19 attaching and leaving


def test_S18_attaching_commands_nothing(rig: SafetyRig) -> None:
    rig.attach()
    assert not rig.written()
    assert not rig.events("motion_started", 0.0)


def test_S18_enabling_aims_at_the_measured_position(rig: JointRig) -> None:
    rig.attach()
    rig.place(0.3)
    there_rad = rig.truth().position_rad
    wait_until(lambda: rig.device.state().position_rad == pytest.approx(there_rad, abs=2e-3), "it is measured")
    mark = written_now()
    rig.device.enable()
    assert all(target == pytest.approx(there_rad, abs=rig.exactly_rad) for target in rig.targets_rad(mark))
    assert not rig.sent_away(mark)
    assert rig.truth().torque
    assert rig.truth().position_rad == pytest.approx(there_rad, abs=2e-3)
    assert not rig.events("motion_started", mark)


def test_S18_replugging_never_enables_and_never_commands(rig: Any) -> None:
    rig.attach()
    rig.ready()
    rig.move()
    mark = written_now()
    rig.bench.sim.do(Unplug())
    wait_until(lambda: not answers(rig.device.state), "the driver noticed")
    rig.bench.sim.do(Replug())
    wait_until(lambda: answers(rig.device.state), "the driver is back")
    rig.judge_return()
    assert not rig.commanded(mark)
    assert not rig.events("motion_started", mark)
    assert not rig.events("torque_on", mark)


def test_S19_shutdown_while_moving_stops_first(rig: SafetyRig) -> None:
    rig.attach()
    moving = rig.set_off()
    rig.robot.close()
    rig.robot.close()
    assert isinstance(moving.wait().error, TradeError)
    assert rig.at_rest()
    rig.rests()
    with pytest.raises(DeviceFault, match="ended"):
        rig.move()


def test_S19_shutdown_holds_the_position_disarms_the_watchdog_and_moves_nothing(rig: JointRig) -> None:
    rig.attach()
    rig.device.move_to(0.3)
    mark = written_now()
    rig.robot.close()
    assert rig.disarmed()
    pass_s(0.6)
    assert rig.truth().torque
    assert not rig.sent_away(mark)
    assert not rig.events("watchdog_expired", mark)


def test_S19_shutdown_with_relax_switches_torque_off(rig: JointRig) -> None:
    rig.leaves("relax")
    rig.attach()
    rig.device.move_to(0.3)
    mark = written_now()
    rig.robot.close()
    rig.bench.wait_for("torque_off", FIRST, mark)
    assert not rig.truth().torque
    assert not rig.sent_away(mark)


# --- S22 limits


def test_S22_what_is_outside_of_the_limits_is_refused_and_nothing_is_sent(rig: SafetyRig) -> None:
    rig.attach()
    mark = written_now()
    for command in rig.outside():
        with pytest.raises((LimitExceeded, InvalidArgument)):
            command()
    assert not rig.commanded(mark)


def test_S22_a_goal_outside_is_refused_with_its_limits(rig: JointRig) -> None:
    rig.attach()
    for value in (rig.max_rad + 0.001, -rig.max_rad - 0.001, 7.0, 1e300):
        with pytest.raises(LimitExceeded) as refused:
            rig.device.move_to(value)
        assert (refused.value.value, refused.value.lower, refused.value.upper) == (value, -rig.max_rad, rig.max_rad)


def test_S22_the_ends_of_the_range_belong_to_it(rig: JointRig) -> None:
    rig.attach()
    for end in (rig.max_rad, -rig.max_rad):
        assert rig.device.move_to(end) == pytest.approx(end, abs=0.03)


def test_S22_a_move_back_inside_is_allowed_from_outside(rig: JointRig) -> None:
    rig.place(rig.max_rad + 0.28)
    rig.attach()
    assert rig.device.state().position_rad > rig.max_rad + 0.2
    assert rig.device.move_to(0.5) == pytest.approx(0.5, abs=0.03)
    assert len(rig.events("motion_started", 0.0)) == 1


def test_S22_the_bus_thread_looks_at_the_limits_itself(rig: JointRig) -> None:
    rig.attach()
    rig.ready()
    mark = written_now()
    move = rig.forged(rig.max_rad + 0.2, Lost(99))
    with pytest.raises(LimitExceeded):
        move.wait(lambda: True)
    assert not rig.sent_away(mark)
