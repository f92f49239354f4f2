"""The motion rules, by their numbers; the judge is what the simulated servos received and did."""

import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import trade_hil_sim
from tests.support.simulated_robots import HEAD
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, call, goal_counts, is_silent, sleep_past, written_now
from tests.unit.drivers.gate import Gate
from trade import permit, service
from trade.errors import (
    ConfigurationError,
    DeadlineExceeded,
    DeviceError,
    DeviceFault,
    DeviceSilent,
    InvalidArgument,
    LimitExceeded,
    MotionStopped,
    OutcomeUnknown,
)
from trade_hil_sim import Servo, instructions, received

WATCHDOG_S = 0.3


# --- S01 late is never


@pytest.mark.parametrize("command", ["move_to", "enable", "relax"])
def test_S01_a_command_that_expires_while_the_bus_is_held_up_is_never_written(
    head: Rig, gate: Gate, command: str
) -> None:
    pan = head.attach(healthy=gate).motor("neck.pan")
    act: dict[str, Callable[[], object]] = {
        "move_to": lambda: pan.move_to(0.5),
        "enable": pan.enable,
        "relax": pan.relax,
    }
    gate.hold_up()
    mark = written_now()
    late = Outcome(act[command], deadline_s=0.05)
    with call(0.05) as expires_ns:
        sleep_past(expires_ns)
    gate.let_go()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not head.moves(since=mark)


def test_S01_a_move_of_an_enabled_joint_that_expires_meanwhile_is_never_written(head: Rig, gate: Gate) -> None:
    pan = head.attach(healthy=gate).motor("neck.pan")
    pan.enable()
    gate.hold_up()
    mark = written_now()
    late = Outcome(lambda: pan.move_to(0.5), deadline_s=0.05)
    with call(0.05) as expires_ns:
        sleep_past(expires_ns)
    gate.let_go()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not head.moves(since=mark)


def test_S01_a_command_that_expires_while_a_silent_joint_holds_the_bus_up_is_never_written(head: Rig) -> None:
    robot = head.attach()
    head.sim.do(trade_hil_sim.Mute(ids=(1, 2)))
    wait_until(lambda: is_silent(robot, "neck.pan"), "the joint is silent")
    mark = written_now()
    late = Outcome(lambda: robot.motor("neck.pan").move_to(0.5), deadline_s=0.1)
    assert late.wait().error is not None
    head.sim.do(trade_hil_sim.Heal())
    wait_until(lambda: not is_silent(robot, "neck.pan"), "the joint answers")
    assert not head.moves(since=mark)


def test_S01_a_plain_call_waits_one_second_for_its_turn_at_most(head: Rig, gate: Gate) -> None:
    pan = head.attach(healthy=gate).motor("neck.pan")
    gate.hold_up()
    mark = written_now()
    late = Outcome(lambda: pan.move_to(0.5))
    with call(1.05) as expires_ns:
        sleep_past(expires_ns)
    gate.let_go()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not head.moves(since=mark)


def test_S01_an_enable_that_went_out_and_then_expired_unheard_is_not_said_to_have_not_run(head: Rig) -> None:
    pan = head.attach().motor("neck.pan")
    head.sim.do(trade_hil_sim.Mute(ids=(1,), instruction="write"))
    error = Outcome(pan.enable, deadline_s=0.05).wait().error
    assert isinstance(error, OutcomeUnknown | DeviceSilent)


# --- S06 the last resort is in the device


class Child:
    def __init__(self, rig: Rig, tmp_path: Path) -> None:
        file = tmp_path / "head.toml"
        file.write_text(HEAD)
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("driver_process.py")), str(file), str(rig.sim.port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == "attached"

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def child(head: Rig, tmp_path: Path) -> Iterator[Child]:
    made = Child(head, tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill -9", "SIGSTOP"])
def test_S06_a_driver_process_that_dies_or_freezes_while_moving_is_stopped_by_the_watchdog(
    head: Rig, child: Child, number: int
) -> None:
    head.wait_for("motion_started", 1)
    child.signal(number)
    expired = head.wait_for("watchdog_expired", 1)
    assert head.wait_for("at_rest", 1).t >= expired.t
    last_heard = max(entry.t for entry in instructions(head.log) if entry.t <= expired.t)
    assert expired.t - last_heard == pytest.approx(WATCHDOG_S, abs=0.05)
    assert head.truth(1).position_rad < 1.25


def test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why(head: Rig, child: Child) -> None:
    head.wait_for("motion_started", 1)
    child.signal(signal.SIGSTOP)
    expired = head.wait_for("watchdog_expired", 1)
    head.wait_for("at_rest", 1)
    rested = head.truth(1).position_counts
    sleep_past(int((expired.t + 2.0) * 1e9))  # at its speed the joint would have got 130 counts farther
    child.signal(signal.SIGCONT)
    assert child.process.stdout is not None
    assert "held up for 2." in (said := child.process.stdout.readline())
    assert "watchdog" in said
    assert not [entry for entry in head.goals(1, expired.t) if abs(goal_counts(entry) - rested) > 40]
    assert head.truth(1).position_counts == rested
    assert not head.events("motion_started", 1, since=expired.t)
    assert not head.events("watchdog_cleared", 1)


def test_S06_after_the_watchdog_only_an_explicit_enable_lets_it_move_again(head: Rig, child: Child) -> None:
    head.wait_for("motion_started", 1)
    child.signal(signal.SIGKILL)
    head.wait_for("watchdog_expired", 1)
    child.close()
    pan = head.attach().motor("neck.pan")
    mark = written_now()
    with pytest.raises(DeviceFault, match="watchdog"):
        pan.move_to(0.0)
    assert not head.moves(since=mark)
    pan.enable()
    assert pan.move_to(0.0) == pytest.approx(0.0, abs=0.03)


def test_S06_an_unhealthy_process_holds_once_and_falls_silent(head: Rig, gate: Gate) -> None:
    pan = head.attach(healthy=gate).motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(1.3, 0.2))
    head.wait_for("motion_started", 1)
    gate.says = False
    expired = head.wait_for("watchdog_expired", 1)
    assert moving.wait().error is not None
    held = head.goals(1)[-1]
    assert goal_counts(held) < 2048 + 1.3 * 4096 / math.tau - 40
    assert not received(head.log, since=held.t + 0.01, until=expired.t)
    with pytest.raises(DeviceFault, match="not healthy"):
        pan.enable()


def test_S06_a_health_check_that_fails_counts_as_no(head: Rig) -> None:
    sick = threading.Event()

    def check() -> bool:
        if sick.is_set():
            raise RuntimeError("broken")
        return True

    pan = head.attach(healthy=check).motor("neck.pan")
    pan.enable()
    sick.set()
    head.wait_for("watchdog_expired", 1)


def test_S06_a_defect_in_the_bus_thread_is_silence_and_an_error_for_everybody(
    head: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = head.attach()
    pan = robot.motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(1.3, 0.1))
    head.wait_for("motion_started", 1)

    def defect() -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(pan._exchange, "_read", defect)  # type: ignore[attr-defined]
    assert "a defect" in str(moving.wait().error)
    head.wait_for("watchdog_expired", 1)
    for act in (pan.state, pan.enable, pan.stop, lambda: pan.move_to(0.0)):
        with pytest.raises(DeviceError):
            act()
    robot.close()


def test_S06_every_enabled_joint_has_its_watchdog_armed(head: Rig) -> None:
    head.attach().group("head").enable()
    assert [head.truth(i).watchdog for i in (1, 2)] == [15, 15]


# --- S07, S08 stop


def test_S07_a_stop_waits_for_one_exchange_at_most_although_a_joint_is_silent(head: Rig) -> None:
    robot = head.attach()
    pan = robot.motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(1.3, 0.1))
    head.wait_for("motion_started", 1)
    seen = len(instructions(head.log))
    head.sim.do(trade_hil_sim.Mute(ids=(2,)))
    wait_until(lambda: len(instructions(head.log)) > seen + 1, "the bus waits for the silent joint")
    asked = written_now()
    pan.stop()
    written = head.goals(1, since=asked)[0]
    before = [entry.name for entry in instructions(head.log, since=asked) if entry.t < written.t]
    assert len(before) <= 1, before
    assert isinstance(moving.wait().error, MotionStopped)


def test_S07_no_exchange_waits_longer_than_a_stop_may() -> None:
    from trade_drivers.bus import _serial_port

    assert _serial_port.LONGEST_WAIT_S < 0.050


def test_S08_a_command_admitted_before_a_stop_is_dropped_after_it(head: Rig, gate: Gate) -> None:
    pan = head.attach(healthy=gate).motor("neck.pan")
    pan.enable()
    gate.hold_up()
    mark = written_now()
    resting = head.truth(1).position_counts
    moving = Outcome(lambda: pan.move_to(0.5))
    wait_until(lambda: pan._exchange._inbox, "the move is admitted")  # type: ignore[attr-defined]
    stopping = Outcome(pan.stop)
    wait_until(lambda: pan._exchange._stops, "the stop is admitted")  # type: ignore[attr-defined]
    gate.let_go()
    assert isinstance(moving.wait().error, MotionStopped)
    stopping.wait()
    assert all(abs(goal_counts(entry) - resting) <= 1 for entry in head.goals(1, mark))
    assert not head.events("motion_started", 1, mark)


def test_S08_a_stop_holds_where_the_joint_is(head: Rig) -> None:
    pan = head.attach().motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(1.3, 1.0))
    wait_until(lambda: head.truth(1).position_rad > 0.3, "it is under way")
    mark = written_now()
    pan.stop()
    held = goal_counts(head.goals(1, mark)[0])
    assert abs(head.truth(1).position_counts - held) < 100
    assert head.truth(1).velocity_rad_s == pytest.approx(0, abs=0.03)
    assert isinstance(moving.wait().error, MotionStopped)


# --- S17


def test_S17_a_provider_that_moves_but_cannot_be_stopped_is_refused(start_container) -> None:
    class Unstoppable:
        resources = ("rosie.wheel",)

        @service
        def go(self) -> None: ...

    class Stoppable(Unstoppable):
        @service(effect="stop")
        def stop(self) -> None: ...

    container = start_container("driver")
    container.register(Stoppable(), "rosie.wheel")
    with pytest.raises(ConfigurationError, match="cannot be stopped"):
        container.register(Unstoppable(), "rosie.wheel")


# --- S22 limits


@pytest.mark.parametrize("value", [1.401, -1.401, 7.0, 1e300])
def test_S22_a_goal_outside_is_refused_with_its_limits_and_nothing_is_sent(head: Rig, value: float) -> None:
    pan = head.attach().motor("neck.pan")
    mark = written_now()
    with pytest.raises(LimitExceeded) as refused:
        pan.move_to(value)
    assert (refused.value.value, refused.value.lower, refused.value.upper) == (value, -1.4, 1.4)
    assert not head.moves(since=mark)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_S22_what_is_no_number_is_refused_and_nothing_is_sent(head: Rig, value: float) -> None:
    robot = head.attach()
    for act in (
        lambda: robot.motor("neck.pan").move_to(value),
        lambda: robot.motor("neck.pan").move_to(0.1, value),
        lambda: robot.group("head").move_to([0.1, value]),
    ):
        with pytest.raises(InvalidArgument):
            act()
    assert not head.moves()


@pytest.mark.parametrize("speed", [2.51, 0.0, -1.0, 0.001])
def test_S22_a_speed_outside_is_refused_and_nothing_is_sent(head: Rig, speed: float) -> None:
    robot = head.attach()
    with pytest.raises(LimitExceeded):
        robot.motor("neck.pan").move_to(0.1, speed)
    with pytest.raises(LimitExceeded):
        robot.group("head").move_to([0.1, 0.1], speed)
    assert not head.moves()


def test_S22_one_value_outside_refuses_the_whole_group(head: Rig) -> None:
    robot = head.attach()
    with pytest.raises(LimitExceeded, match=r"rosie\.neck\.tilt"):
        robot.group("head").move_to([0.1, 0.7])
    assert not head.moves()


def test_S22_a_move_back_inside_is_allowed_from_outside(rig: Rig) -> None:
    rig.plug(Servo(1, position_counts=2048 + 1100), Servo(2))
    pan = rig.attach().motor("neck.pan")
    assert pan.state().position_rad > 1.6
    assert pan.move_to(1.0) == pytest.approx(1.0, abs=0.03)


def test_S22_the_ends_of_the_range_belong_to_it(head: Rig) -> None:
    pan = head.attach().motor("neck.pan")
    assert pan.move_to(1.4) == pytest.approx(1.4, abs=0.03)
    assert pan.move_to(-1.4) == pytest.approx(-1.4, abs=0.03)


def test_S22_the_bus_thread_looks_at_the_limits_itself(head: Rig) -> None:
    from trade_drivers.joints._motion import Move

    pan = head.attach().motor("neck.pan")
    pan.enable()
    mark = written_now()
    exchange, axes = pan._exchange, pan._axes  # type: ignore[attr-defined]
    expires_ns = exchange.clock() + 10**9
    with permit(pan.resources) as permitted:
        move = Move(
            exchange, axes, [4000], [50], service="forged", expires_ns=expires_ns, until_ns=None, permit=permitted
        )
        exchange.submit(move)
        with pytest.raises(LimitExceeded):
            move.wait(lambda: True)
    assert not head.moves(since=mark)
