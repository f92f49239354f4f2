"""The rules of motion for ODrives and Damiao motors, judged on frames: the numbers are those of docs/safety.md."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, sleep_past, written_now
from tests.unit.drivers.motor_rig import ROOT, TIP, MotorRig, motor_rig, wag
from tests.unit.drivers.test_cia402_safety import Frozen, Lost
from trade import Container, where
from trade.errors import (
    DeadlineExceeded,
    DeviceFault,
    LimitExceeded,
    LockedByOther,
    MotionStopped,
    TradeError,
)
from trade_drivers import Motor
from trade_drivers.joints._motion import Move
from trade_hil_sim import Mute, Place, Replug, Unplug

__all__ = ["motor_rig", "wag"]


def test_S01_a_command_that_is_late_at_the_wire_is_never_sent(
    motor_rig: MotorRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    motor_rig.configure(("watchdog_s = 0.4", "watchdog_s = 0.5"))
    motor_rig.plug()
    root = motor_rig.attach().motor("tail.root")
    root.enable()
    frozen = Frozen(root, monkeypatch)
    mark = written_now()
    late = Outcome(lambda: root.move_to(0.5), deadline_s=0.2)
    sleep_past(time.monotonic_ns() + 250_000_000)
    frozen.thaw()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not motor_rig.sent_away(ROOT, mark)
    assert not motor_rig.events("motion_started", ROOT, mark)


def test_S05_a_motion_ends_with_its_session(wag: MotorRig, start_container: Callable[..., Container]) -> None:
    driver = start_container("driver")
    wag.attach(register=driver.register, deregister=driver.deregister)
    planner = start_container("planner")
    move = planner.find(where(name="move_to", group="rosie.tail.root"), wait_s=20).with_(deadline_s=60)
    move.start(0.9, 0.1)
    began = wag.wait_for("motion_started", ROOT)
    planner.close()
    wag.wait_for("at_rest", ROOT, began.t)
    assert wag.truth(ROOT).position_rad < 0.8


# --- the last resort


class Child:
    """A driver process that moves the root slowly."""

    def __init__(self, rig: MotorRig, tmp_path: Path) -> None:
        file = tmp_path / "tail.toml"
        file.write_text(rig.text)
        script = str(Path(__file__).with_name("driver_process.py"))
        self.process = subprocess.Popen(
            [sys.executable, script, str(file), rig.sim.port, "tail", "tail.root"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == "attached"

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def child(wag: MotorRig, tmp_path: Path) -> Iterator[Child]:
    made = Child(wag, tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill -9", "SIGSTOP"])
def test_S06_a_driver_process_that_dies_or_freezes_while_moving_leaves_no_torque(
    wag: MotorRig, child: Child, number: int
) -> None:
    moving = wag.wait_for("motion_started", ROOT)
    os.kill(child.process.pid, number)
    expired = wag.wait_for("watchdog_expired", ROOT, moving.t)
    wag.wait_for("torque_off", ROOT, moving.t)
    wait_until(lambda: not wag.truth(ROOT).moving, "it is at rest")
    assert not wag.commanded(ROOT, expired.t)
    assert wag.truth(ROOT).position_rad < 0.9


def test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why(wag: MotorRig, child: Child) -> None:
    moving = wag.wait_for("motion_started", ROOT)
    os.kill(child.process.pid, signal.SIGSTOP)
    expired = wag.wait_for("watchdog_expired", ROOT, moving.t)
    os.kill(child.process.pid, signal.SIGCONT)
    assert child.process.stdout is not None
    said = child.process.stdout.readline()
    assert "DeviceFault" in said or "DeviceSilent" in said
    assert not wag.events("torque_on", ROOT, expired.t)


def test_S06_a_process_that_is_not_healthy_holds_then_falls_silent(wag: MotorRig) -> None:
    healthy = True
    root = wag.attach(healthy=lambda: healthy).motor("tail.root")
    root.enable()
    moving = Outcome(lambda: root.move_to(0.9, 0.2))
    started = wag.wait_for("motion_started", ROOT)
    healthy = False
    assert moving.wait().error is not None
    expired = wag.wait_for("watchdog_expired", ROOT, started.t)
    assert wag.truth(ROOT).position_rad < 0.5
    mark = written_now()
    sleep_past(time.monotonic_ns() + 200_000_000)
    assert not [e for e in wag.frames(since=mark) if e.direction == "in"], "it is silent from then on"
    assert not wag.events("torque_on", ROOT, expired.t)


# --- stop


def test_S07_a_stop_gets_through_while_another_motor_is_silent(wag: MotorRig) -> None:
    root = wag.attach().motor("tail.root")
    root.enable()
    wag.sim.do(Mute(ids=(TIP,)))
    mark = written_now()
    moving = Outcome(lambda: root.move_to(0.9, 0.2))
    started = wag.wait_for("motion_started", ROOT, mark)
    root.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    assert wag.wait_for("at_rest", ROOT, started.t)
    assert wag.truth(ROOT).torque


def test_S08_a_command_admitted_before_a_stop_is_dropped_however_fresh(
    wag: MotorRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = wag.attach().motor("tail.root")
    root.enable()
    exchange: Any = root._exchange
    frozen = Frozen(root, monkeypatch)
    mark = written_now()
    move = Outcome(lambda: root.move_to(0.5))
    wait_until(lambda: exchange._inbox, "the move was admitted")
    stop = Outcome(root.stop)
    wait_until(lambda: exchange._stops, "the stop was admitted")
    frozen.thaw()
    assert isinstance(move.wait().error, MotionStopped)
    stop.wait()
    assert not wag.sent_away(ROOT, mark)


def test_a_stop_halts_every_joint_of_a_group_that_moves(wag: MotorRig) -> None:
    robot = wag.attach()
    group = robot.group("tail")
    group.enable()
    mark = written_now()
    moving = Outcome(lambda: group.move_to([0.9, 0.9], 0.3))
    started = wag.wait_for("motion_started", TIP, mark)
    robot.motor("tail.root").stop()
    assert isinstance(moving.wait().error, MotionStopped)
    for joint in (ROOT, TIP):
        wag.wait_for("at_rest", joint, started.t)
        assert wag.truth(joint).position_rad < 0.8


# --- locks


@pytest.mark.parametrize("looks", [0, 2])
def test_S11_a_command_whose_lock_is_gone_is_kept_off_the_wire(wag: MotorRig, looks: int) -> None:
    root = wag.attach().motor("tail.root")
    exchange, axes = root._exchange, root._axes
    mark = written_now()
    permit: Any = Lost(looks)
    expires_ns = exchange.clock() + 10**10
    goals = [round(axes[0].scale.counts(0.5))]
    move = Move(exchange, axes, goals, [5000], service="x", expires_ns=expires_ns, until_ns=None, permit=permit)
    exchange.submit(move)
    with pytest.raises(LockedByOther):
        move.wait(lambda: True)
    assert not wag.sent_away(ROOT, mark)
    assert not wag.events("motion_started", ROOT, mark)


def test_S22_the_bus_thread_looks_at_the_limits_itself(wag: MotorRig) -> None:
    root = wag.attach().motor("tail.root")
    root.enable()
    exchange, axes = root._exchange, root._axes
    expires_ns = exchange.clock() + 10**10
    permit: Any = Lost(10**6)
    goals = [round(axes[0].scale.counts(1.2))]
    mark = written_now()
    move = Move(exchange, axes, goals, [5000], service="x", expires_ns=expires_ns, until_ns=None, permit=permit)
    exchange.submit(move)
    with pytest.raises(LimitExceeded):
        move.wait(lambda: True)
    assert not wag.sent_away(ROOT, mark)


# --- attaching and leaving


def test_S18_attaching_commands_nothing(wag: MotorRig) -> None:
    wag.attach()
    assert not wag.commanded()
    assert not wag.events("motion_started")


def test_S18_enabling_aims_at_the_measured_position(wag: MotorRig) -> None:
    root = wag.attach().motor("tail.root")
    wag.sim.do(Place(counts=300, ids=(ROOT,)))
    there_rad = wag.truth(ROOT).position_rad
    wait_until(lambda: root.state().position_rad == pytest.approx(there_rad, abs=1e-3), "it is measured")
    mark = written_now()
    root.enable()
    targets = wag.targets(ROOT, mark)
    gear = wag.robot.joints[0].gear
    assert targets
    assert all(target == pytest.approx(there_rad * gear, abs=2e-3 * gear) for target in targets)
    assert not wag.events("motion_started", ROOT, mark)


def test_S18_replugging_never_enables_and_never_commands(wag: MotorRig) -> None:
    robot = wag.attach()
    root = robot.motor("tail.root")
    root.move_to(0.3)
    wag.sim.do(Unplug())
    wait_until(lambda: not answers(root), "the driver noticed")
    mark = written_now()
    wag.sim.do(Replug())
    wait_until(lambda: answers(root) and answers(robot.motor("tail.tip")), "the driver is back")
    with pytest.raises(DeviceFault):
        root.move_to(0.0)
    assert not wag.commanded(since=mark)
    assert not wag.events("motion_started", since=mark)
    assert not wag.events("torque_on", since=mark)


def test_S19_leaving_while_moving_stops_first_and_relaxes(wag: MotorRig) -> None:
    robot = wag.attach()
    root = robot.motor("tail.root")
    root.enable()
    mark = written_now()
    moving = Outcome(lambda: root.move_to(0.9, 0.3))
    wag.wait_for("motion_started", ROOT, mark)
    robot.close()
    assert isinstance(moving.wait().error, TradeError)
    rest, off = wag.wait_for("at_rest", ROOT, mark), wag.wait_for("torque_off", ROOT, mark)
    assert rest.position_rad is not None
    assert off.position_rad is not None
    assert abs(rest.position_rad - off.position_rad) < 0.002  # it did not coast: its speed was nothing when it let go
    assert wag.truth(ROOT).position_rad < 0.8


def answers(motor: Motor) -> bool:
    try:
        motor.state()
    except TradeError:
        return False
    return True
