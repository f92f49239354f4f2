"""The motion rules, by their numbers; the judge is what the simulated servos received and did."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import trade_hil_sim
from tests.support.simulated_robots import HEAD
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, is_silent, written_now
from trade import errors, permit, service
from trade_drivers.bus._gate import Terms
from trade_drivers.joints._jobs import Enable
from trade_drivers.vendors.dynamixel import DynamixelDriver

pytestmark = pytest.mark.virtual_time


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


def test_S01_an_enable_that_went_out_and_then_expired_unheard_is_not_said_to_have_not_run(head: Rig) -> None:
    pan = head.attach().motor("neck.pan")
    head.sim.do(trade_hil_sim.Mute(ids=(1,), instruction="write"))
    error = Outcome(pan.enable, deadline_s=0.05).wait().error
    assert isinstance(error, errors.OutcomeUnknown | errors.DeviceSilent)


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


@pytest.mark.realtime
def test_S06_after_the_watchdog_only_an_explicit_enable_lets_it_move_again(head: Rig, child: Child) -> None:
    head.wait_for("motion_started", 1)
    child.signal(signal.SIGKILL)
    head.wait_for("watchdog_expired", 1)
    child.close()
    pan = head.attach().motor("neck.pan")
    mark = written_now()
    with pytest.raises(errors.DeviceFault, match="watchdog"):
        pan.move_to(0.0)
    assert not head.moves(since=mark)
    pan.enable()
    assert pan.move_to(0.0) == pytest.approx(0.0, abs=0.03)


def test_S07_no_exchange_waits_longer_than_a_stop_may() -> None:
    from trade_drivers.bus import _serial_port

    assert _serial_port.LONGEST_WAIT_S < 0.050


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
    with pytest.raises(errors.ConfigurationError, match="cannot be stopped"):
        container.register(Unstoppable(), "rosie.wheel")


def test_S22_one_value_outside_refuses_the_whole_group(head: Rig) -> None:
    robot = head.attach()
    with pytest.raises(errors.LimitExceeded, match=r"rosie\.neck\.tilt"):
        robot.group("head").move_to([0.1, 0.7])
    assert not head.moves()


@pytest.mark.parametrize(("still", "holds"), [(0, True), (1, True), (2, False)])
def test_S08_a_stop_holds_a_joint_that_only_its_last_measurement_shows_at_rest(
    head: Rig, still: int, holds: bool
) -> None:
    exchange = DynamixelDriver().open_exchange(head.robot, head.robot.buses[0], str(head.sim.port))
    try:
        pan = exchange.devices[0]
        with permit([pan.resource]) as permitted:
            job = Enable(exchange, [pan], Terms("test", 2**63, None, permitted))
            exchange.submit(job)
            while not job.ended:
                exchange.cycle()
        for _ in range(3):
            exchange.cycle()
        pan.still = still  # as at the turning point of a joint that swings
        mark = written_now()
        exchange.stop([pan])
        exchange.cycle()
        assert bool(trade_hil_sim.writes(head.log, device_id=1, register="goal_position", since=mark)) == holds
    finally:
        exchange.wire.close()


def test_a_servo_that_does_not_come_back_after_its_restart_ends_its_enabling(
    head: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    pan, servo = head.attach().motor("neck.pan"), head.sim.devices[0]
    restart = servo.reboot

    def and_stay_away(t: float) -> None:
        restart(t)
        head.sim.do(trade_hil_sim.Mute(ids=(1,)))

    monkeypatch.setattr(servo, "reboot", and_stay_away)
    head.sim.do(trade_hil_sim.HardwareFault(ids=(1,), bits=0x20))
    wait_until(lambda: "overload" in pan.state().fault, "its fault is reported")
    enabling = Outcome(pan.enable)
    wait_until(lambda: trade_hil_sim.instructions(head.log, "reboot"), "it restarts")
    began = time.monotonic()
    error = enabling.wait().error
    assert isinstance(error, errors.DeviceSilent)
    assert "neck.pan did not answer" in str(error)
    assert time.monotonic() - began < 5.0
    assert not head.truth(1).torque


def test_a_servo_that_lost_what_enabling_wrote_is_not_enabled(head: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    pan, servo = head.attach().motor("neck.pan"), head.sim.devices[0]
    pan.relax()
    switch_on = servo._torque_on

    def with_too_weak_a_supply(t: float) -> None:
        switch_on(t)
        servo.reboot(t)

    monkeypatch.setattr(servo, "_torque_on", with_too_weak_a_supply)
    with pytest.raises(errors.DeviceFault, match="did not keep what enabling it wrote"):
        pan.enable()
    assert not head.truth(1).torque
