"""The rules of motion on a CAN bus, judged on frames: the numbers are those of docs/safety.md."""

import time
from collections.abc import Callable
from typing import Any

import can
import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.conftest import Outcome, sleep_past, written_now
from tests.unit.drivers.legs import HALT, HIP, KNEE, PATIENT, Leg, leg, rig
from trade import Container, where
from trade.errors import DeviceFault, LockedByOther, MotionStopped
from trade_drivers.bus._gate import Terms
from trade_drivers.joints._motion import Move
from trade_hil_sim import Entry

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]

QUICK_STOP = 0x02
"""Of bits 1, 2 and 7 of the controlword only the first (CiA 402-2, device control commands)."""


def states(leg: Leg, device_id: int, since: float) -> list[str]:
    return [entry.detail for entry in leg.events("state", device_id, since)]


def heartbeats(leg: Leg, since: float = 0.0) -> list[Entry]:
    return [entry for entry in leg.frames("heartbeat", since=since) if entry.can_id == 0x77F]


# --- time


@pytest.mark.realtime
def test_S01_a_search_for_home_that_does_not_end_in_time_is_halted_before_its_deadline(
    rig: Leg, start_container: Callable[..., Container]
) -> None:
    rig.configure(PATIENT)
    rig.plug()
    driver = start_container("driver")
    with rig.attach(register=driver.register, deregister=driver.deregister) as robot:
        robot.motor("leg.hip").enable()
        search = start_container("planner").find(where(name="home", group="rosie.leg.hip"), wait_s=20)
        with pytest.raises(DeviceFault, match="has not found its home in time"):
            search.with_(deadline_s=1.5)(34, 0.01)
        began = rig.wait_for("motion_started", HIP).t
        assert any(word & HALT or word & 0x86 == QUICK_STOP for word in rig.controlwords(HIP, began))


# --- the last resort


def test_S06_the_watchdog_of_every_drive_is_armed_at_attach_and_fed_from_then_on(leg: Leg) -> None:
    leg.attach()
    for joint in (HIP, KNEE):
        writes = [e.data for e in leg.frames("sdo_request", joint)]
        assert bytes.fromhex("23161001") + (127 << 16 | 300).to_bytes(4, "little") in writes
        assert bytes.fromhex("2b076000 03000000") in writes
    count = len(heartbeats(leg))
    wait_until(lambda: len(heartbeats(leg)) >= count + 3, "the heartbeat continues")


# --- stop


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


def test_a_halted_drive_does_not_continue_to_its_old_goal_when_it_is_moved_again(leg: Leg) -> None:
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
            raise LockedByOther(resources=["rosie.leg.hip"], owner="another client", purpose="walk")


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


def test_S18_a_moving_drive_without_an_owner_is_stopped_and_left_enabled(leg: Leg) -> None:
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


def test_S19_shutdown_while_moving_stops_first_and_disarms_what_holds(leg: Leg) -> None:
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


# --- S23 what the device says about itself
