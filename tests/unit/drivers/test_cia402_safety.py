"""The rules of motion on a CAN bus, judged on frames: the numbers are those of docs/safety.md."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.conftest import Outcome, sleep_past, written_now
from tests.unit.drivers.legs import HALT, HIP, KNEE, Leg, leg, rig
from trade.errors import DeadlineExceeded, DeviceFault, LockedByOther, MotionStopped
from trade_drivers.bus._deadlines import Terms
from trade_drivers.joints._motion import Move
from trade_hil_sim import Entry, Mute

__all__ = ["leg", "rig"]


class Frozen:
    """The bus thread, stopped between two cycles until it is let go."""

    def __init__(self, motor: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        self._reached, self._thaw = threading.Event(), threading.Event()
        cycle = motor._exchange.cycle

        def stand_still() -> None:
            self._reached.set()
            self._thaw.wait(PATIENCE_S)
            cycle()

        monkeypatch.setattr(motor._exchange, "cycle", stand_still)
        assert self._reached.wait(PATIENCE_S)

    def thaw(self) -> None:
        self._thaw.set()


def states(leg: Leg, device_id: int, since: float) -> list[str]:
    return [entry.detail for entry in leg.events("state", device_id, since)]


def heartbeats(leg: Leg, since: float = 0.0) -> list[Entry]:
    return [entry for entry in leg.frames("heartbeat", since=since) if entry.can_id == 0x77F]


# --- time


def test_S01_a_command_that_is_late_at_the_wire_is_never_sent(rig: Leg, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.configure(('channel = "can0"', 'channel = "can0"\nwatchdog_s = 2'))
    rig.plug()
    hip = rig.attach().motor("leg.hip")
    hip.enable()
    frozen = Frozen(hip, monkeypatch)
    mark = written_now()
    late = Outcome(lambda: hip.move_to(0.5), deadline_s=0.2)
    sleep_past(time.monotonic_ns() + 250_000_000)
    frozen.thaw()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not rig.goals(HIP, mark)
    assert not rig.events("motion_started", HIP, mark)


# --- the last resort


class Child:
    """A driver process that moves the hip slowly."""

    def __init__(self, leg: Leg, tmp_path: Path) -> None:
        file = tmp_path / "leg.toml"
        file.write_text(leg.text)
        script = str(Path(__file__).with_name("driver_process.py"))
        self.process = subprocess.Popen(
            [sys.executable, script, str(file), leg.sim.port, "legs", "leg.hip"],
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
def child(leg: Leg, tmp_path: Path) -> Iterator[Child]:
    made = Child(leg, tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill -9", "SIGSTOP"])
def test_S06_a_driver_process_that_dies_or_freezes_while_moving_is_stopped_by_the_drive(
    leg: Leg, child: Child, number: int
) -> None:
    moving = leg.wait_for("motion_started", HIP)
    os.kill(child.process.pid, number)
    wait_until(lambda: "quick_stop_active" in states(leg, HIP, moving.t), "the drive makes a quick stop")
    stopped = next(e for e in leg.events("state", HIP, moving.t) if e.detail == "quick_stop_active")
    leg.wait_for("at_rest", HIP, stopped.t)
    assert not leg.frames("rpdo1", HIP, stopped.t)
    assert heartbeats(leg)[-1].t < stopped.t
    assert leg.truth(HIP).position_rad < 0.9
    assert states(leg, HIP, stopped.t)[-1] == "quick_stop_active"  # it stands under torque: the leg does not fall


def test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why(leg: Leg, child: Child) -> None:
    moving = leg.wait_for("motion_started", HIP)
    os.kill(child.process.pid, signal.SIGSTOP)
    wait_until(lambda: "quick_stop_active" in states(leg, HIP, moving.t), "the drive makes a quick stop")
    rest = leg.wait_for("at_rest", HIP, moving.t)
    os.kill(child.process.pid, signal.SIGCONT)
    assert child.process.stdout is not None
    said = child.process.stdout.readline()
    assert "DeviceFault" in said or "DeviceSilent" in said
    assert not leg.goals(HIP, rest.t)
    assert not leg.events("motion_started", HIP, rest.t)


def test_S06_a_process_that_is_not_healthy_holds_then_falls_silent(leg: Leg) -> None:
    healthy = True
    hip = leg.attach(healthy=lambda: healthy).motor("leg.hip")
    moving = Outcome(lambda: hip.move_to(0.9, 0.2))
    started = leg.wait_for("motion_started", HIP)
    healthy = False
    assert moving.wait().error is not None
    wait_until(lambda: leg.controlwords(HIP, started.t)[-1] & HALT, "it was halted")
    wait_until(lambda: "quick_stop_active" in states(leg, HIP, started.t), "the drive's own watchdog has its say")


def test_S06_the_watchdog_of_every_drive_is_armed_at_attach_and_fed_from_then_on(leg: Leg) -> None:
    leg.attach()
    for joint in (HIP, KNEE):
        writes = [e.data for e in leg.frames("sdo_request", joint)]
        assert bytes.fromhex("23161001") + (127 << 16 | 300).to_bytes(4, "little") in writes
        assert bytes.fromhex("2b076000 03000000") in writes
    count = len(heartbeats(leg))
    wait_until(lambda: len(heartbeats(leg)) >= count + 3, "the heartbeat goes on")


# --- stop


def test_S07_a_stop_gets_through_while_another_drive_is_silent(leg: Leg) -> None:
    robot = leg.attach()
    hip = robot.motor("leg.hip")
    leg.sim.do(Mute(ids=(KNEE,)))
    moving = Outcome(lambda: hip.move_to(0.9, 0.2))
    started = leg.wait_for("motion_started", HIP)
    hip.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    assert leg.wait_for("at_rest", HIP, started.t)
    assert leg.controlwords(HIP, started.t)[-1] & HALT


def test_S08_a_command_admitted_before_a_stop_is_dropped_however_fresh(
    leg: Leg, monkeypatch: pytest.MonkeyPatch
) -> None:
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    exchange = hip._exchange  # type: ignore[attr-defined]
    frozen = Frozen(hip, monkeypatch)
    mark = written_now()
    move = Outcome(lambda: hip.move_to(0.5))
    wait_until(lambda: exchange._inbox, "the move was admitted")
    stop = Outcome(hip.stop)
    wait_until(lambda: exchange._stops, "the stop was admitted")
    frozen.thaw()
    assert isinstance(move.wait().error, MotionStopped)
    assert stop.wait().error is None
    assert not leg.goals(HIP, mark)


def test_a_stop_halts_every_joint_of_a_group_that_moves(leg: Leg) -> None:
    robot = leg.attach()
    group = robot.group("leg")
    moving = Outcome(lambda: group.move_to([0.9, 0.9], 0.3))
    started = leg.wait_for("motion_started", KNEE)
    robot.motor("leg.hip").stop()
    assert isinstance(moving.wait().error, MotionStopped)
    for joint in (HIP, KNEE):
        assert leg.controlwords(joint, started.t)[-1] & HALT
        leg.wait_for("at_rest", joint, started.t)


def test_a_halted_drive_does_not_go_on_to_its_old_goal_when_it_is_moved_again(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    moving = Outcome(lambda: hip.move_to(0.9, 0.3))
    leg.wait_for("motion_started", HIP)
    hip.stop()
    moving.wait()
    rest = hip.state().position_rad
    mark = written_now()
    hip.enable()
    assert hip.state().position_rad == pytest.approx(rest, abs=0.01)
    assert not leg.events("motion_started", HIP, mark)
    hip.move_to(rest - 0.1)
    assert (
        max(e.position_rad for e in leg.log if e.device_id == HIP and e.t > mark and e.position_rad is not None)
        < rest + 0.01
    )


# --- locks


class Lost:
    """A permit whose lock is another's by the time it is looked at."""

    def __init__(self, good_for: int) -> None:
        self.left = good_for

    def gate(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise LockedByOther(resources=["rosie.leg.hip"], owner="somebody else", purpose="walk")


@pytest.mark.parametrize("looks", [0, 3])
def test_S11_a_command_whose_lock_is_gone_is_kept_off_the_wire(leg: Leg, looks: int) -> None:
    hip = leg.attach().motor("leg.hip")
    exchange, axes = hip._exchange, hip._axes  # type: ignore[attr-defined]
    mark = written_now()
    permit: Any = Lost(looks)
    expires_ns = exchange.clock() + 10**10
    move = Move(exchange, axes, [4000], [500], Terms("x", expires_ns, None, permit))
    exchange.submit(move)
    with pytest.raises(LockedByOther):
        move.wait(lambda: True)
    assert not leg.goals(HIP, mark)
    assert "operation_enabled" not in states(leg, HIP, mark)


# --- attaching and leaving


def test_S18_attaching_commands_nothing(leg: Leg) -> None:
    leg.attach()
    assert not leg.frames("rpdo1")
    assert not [e for e in leg.frames("sdo_request") if e.data[0] & 0xE0 == 0x20 and e.data[1:3] == b"\x40\x60"]
    assert {e.data for e in leg.frames("nmt")} == {bytes((1, HIP)), bytes((1, KNEE))}


def test_S18_a_drive_found_moving_and_owned_by_nobody_is_stopped_and_left_enabled(leg: Leg) -> None:
    with leg.listen() as other:

        def write(index: int, size: int, value: int) -> None:
            head = bytes((0x2F - 4 * (size - 1),)) + index.to_bytes(2, "little") + b"\0"
            data = head + value.to_bytes(4, "little", signed=True)
            other.send(can.Message(arbitration_id=0x600 + HIP, data=data, is_extended_id=False))
            while (answer := other.recv(PATIENCE_S)) is None or answer.arbitration_id != 0x580 + HIP:
                pass
            assert answer.data[0] == 0x60

        write(0x6060, 1, 3)
        write(0x60FF, 4, 5000)
        for word in (0x06, 0x07, 0x0F):
            write(0x6040, 2, word)
        started = leg.wait_for("motion_started", HIP)
    robot = leg.attach()
    rest = leg.wait_for("at_rest", HIP, started.t)
    assert bytes.fromhex("2b4060000f010000") in [e.data for e in leg.frames("sdo_request", HIP, started.t)]
    assert robot.motor("leg.hip").state().enabled
    assert not leg.events("torque_off", HIP, started.t)
    assert not leg.goals(HIP)
    assert not leg.events("motion_started", HIP, rest.t)


def test_S19_leaving_while_moving_stops_first_and_disarms_what_holds(leg: Leg) -> None:
    robot = leg.attach()
    hip = robot.motor("leg.hip")
    moving = Outcome(lambda: hip.move_to(0.9, 0.3))
    started = leg.wait_for("motion_started", HIP)
    robot.close()
    moving.wait()
    leg.wait_for("at_rest", HIP, started.t)
    disarmed = [e for e in leg.frames("sdo_request", HIP) if e.data == bytes.fromhex("2316100100000000")]
    assert disarmed
    assert not leg.events("torque_off", HIP, started.t)
    sleep_past(time.monotonic_ns() + 600_000_000)
    assert not states(leg, HIP, disarmed[-1].t)


def test_S08_a_joint_with_a_fault_has_stopped_when_it_rests_and_not_before(rig: Leg) -> None:
    """What speaks against moving on says nothing of its being at rest: it brakes for as long as any other."""
    rig.configure(
        ("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 1.0"), ("max_speed_rad_s = 2.0", "max_speed_rad_s = 1.0")
    )
    rig.plug()
    hip = rig.attach().motor("leg.hip")
    axis = hip._axes[0]  # type: ignore[attr-defined]
    moving = Outcome(lambda: hip.move_to(0.9, 0.8))
    started = rig.wait_for("motion_started", HIP)
    wait_until(lambda: hip.state().velocity_rad_s > 0.4, "it is on its way")
    axis.latch("it does not take its goal (statusword bit 12)")
    assert isinstance(moving.wait().error, DeviceFault)
    hip.stop()
    assert rig.events("at_rest", HIP, started.t)
    assert rig.controlwords(HIP, started.t)[-1] & HALT
