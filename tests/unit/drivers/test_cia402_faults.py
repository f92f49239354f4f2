"""What goes wrong on a CAN bus, beyond what is in the table of faults: what the others do, and what lasts."""

import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.fault_table import TABLE, Sick
from tests.unit.drivers.legs import HALT, HIP, KNEE, Leg, leg, rig
from trade.errors import DeviceFault, DeviceSilent
from trade_drivers import AttachedRobot, Tolerances, Trajectory, TrajectoryPoint
from trade_drivers.vendors.cia402._exchange import DriveExchange
from trade_hil_sim import (
    Command,
    Duplicate,
    Emergency,
    Heal,
    Late,
    LogEntry,
    Mute,
    Truncate,
)

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]


ROWS = {row.fault: row for row in TABLE if row.device == "cia402"}
UNHEARD = ("silence", "no measurements", "heartbeat lost", "cut short", "cable off", "bus-off of the drive")


@pytest.mark.parametrize("fault", ["silence", "blocked", "EMCY"])
def test_a_fault_of_one_stops_the_others_of_its_group(leg: Leg, fault: str) -> None:
    group = leg.attach().group("leg")
    moving = Outcome(lambda: group.move_to([0.9, 0.9], 0.3))
    started = leg.wait_for("motion_started", KNEE)
    _strike(leg, fault)
    assert isinstance(moving.wait().error, ROWS[fault].error or ())
    assert leg.wait_for("at_rest", KNEE, started.t)
    assert leg.controlwords(KNEE, started.t)[-1] & HALT


def test_a_drive_that_fails_before_it_has_taken_its_goal_moves_again_once_it_is_enabled(
    leg: Leg, monkeypatch: pytest.MonkeyPatch
) -> None:
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    write = DriveExchange.write_positions

    def fail(self: DriveExchange, positions: Any, gate: Any) -> None:
        write(self, positions, gate)
        leg.sim.do(Emergency(ids=(HIP,), code=0x4310))

    with monkeypatch.context() as patch:
        patch.setattr(DriveExchange, "write_positions", fail)
        with pytest.raises(DeviceFault, match="over-temperature"):
            hip.move_to(0.3)
    time.sleep(1.0)
    hip.enable()
    assert hip.move_to(0.3) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("fault", UNHEARD)
def test_a_drive_that_is_not_heard_does_not_keep_the_others(leg: Leg, fault: str) -> None:
    robot = leg.attach()
    hip, knee = robot.motor("leg.hip"), robot.motor("leg.knee")
    _strike(leg, fault)
    wait_until(lambda: _is_silent(hip.state), "the hip is not heard")
    assert knee.move_to(0.3) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("frame", ["tpdo1", "heartbeat"])
def test_a_drive_that_answers_but_is_not_heard_is_not_back_until_it_is(leg: Leg, frame: str) -> None:
    hip = leg.attach().motor("leg.hip")
    axis = hip._axes[0]  # type: ignore[attr-defined]
    leg.sim.do(Mute(ids=(HIP,), instruction=frame))
    wait_until(lambda: axis.silent, "it is given up")
    mark, since_ns = written_now(), axis.silent_since_ns
    wait_until(lambda: len(_set_up(leg, mark)) >= 3, "it was set up again and again")
    assert (axis.silent, axis.silent_since_ns) == (True, since_ns)
    with pytest.raises(DeviceFault, match="node 1 answers, but sends no"):
        hip.move_to(0.1)
    leg.sim.do(Heal())
    wait_until(lambda: not _is_silent(hip.state), "it is back")
    hip.enable()
    assert hip.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_drives_that_are_slow_to_be_attached_are_not_away_when_all_are(rig: Leg) -> None:
    rig.plug()
    rig.sim.do(Late(instruction="sdo_reply", s=0.015))
    rig.sim.do(Mute(instruction="tpdo1", count=3))
    robot = rig.attach()
    assert not any(axis.silent for axis in robot.group("leg")._axes)  # type: ignore[attr-defined]
    assert robot.group("leg").move_to([0.1, 0.1]) == pytest.approx([0.1, 0.1], abs=0.01)


@pytest.mark.parametrize(
    "nuisance",
    [
        Duplicate(ids=(HIP,), instruction="tpdo1"),
        Mute(ids=(HIP,), instruction="tpdo1", count=3),
        Mute(ids=(HIP,), instruction="heartbeat", count=1),
        Truncate(ids=(HIP,), instruction="tpdo2", count=3, missing=3),
    ],
    ids=str,
)
def test_a_small_nuisance_is_forgiven(leg: Leg, nuisance: Command) -> None:
    hip = leg.attach().motor("leg.hip")
    leg.sim.do(nuisance)
    assert hip.move_to(0.3) == pytest.approx(0.3, abs=0.01)


def test_a_fault_that_lasts_cannot_be_cleared_and_one_that_is_over_can(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    leg.sim.do(Emergency(ids=(HIP,), code=0x3220, lasting=True))
    wait_until(lambda: "error 3220h, under-voltage" in hip.state().fault, "the fault is known")
    mark = written_now()
    with pytest.raises(DeviceFault, match="cannot be cleared: error 3220h"):
        hip.enable()
    assert not leg.events("torque_on", HIP, mark)
    leg.sim.do(Heal())
    hip.enable()
    assert (hip.state().fault, hip.state().enabled) == ("", True)


def test_clearing_a_fault_does_not_enable_by_itself(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    leg.sim.do(Emergency(ids=(HIP,), code=0x4310))
    wait_until(lambda: "4310h" in hip.state().fault, "the fault is known")
    mark = written_now()
    hip.enable()
    words = leg.controlwords(HIP, mark)
    assert words[:2] == [0x00, 0x80]
    assert words[2:5] == [0x06, 0x07, 0x10F]


def test_S07_stop_of_a_drive_that_is_not_heard_says_so(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    leg.sim.do(Mute(ids=(HIP,)))
    wait_until(lambda: _is_silent(hip.state), "it is not heard")
    with pytest.raises(DeviceSilent):
        hip.stop()


@pytest.mark.parametrize("act", ["move", "follow"])
def test_a_drive_that_falls_silent_on_its_way_is_not_taken_for_blocked(rig: Leg, act: str) -> None:
    group = _patient(rig).group("leg")
    points = [TrajectoryPoint(time_from_start_s=at, positions_rad=[rad, rad]) for at, rad in ((0.0, 0.0), (1.0, 0.5))]
    course = Trajectory(joints=["rosie.leg.hip", "rosie.leg.knee"], points=points)
    wide = Tolerances(start_rad=1.0, path_rad=2.0, goal_rad=2.0, goal_time_s=0.1)
    acts = {"move": lambda: group.move_to([0.5, 0.5], 0.3), "follow": lambda: group.follow(course, wide)}
    moving = Outcome(acts[act])
    rig.wait_for("motion_started", HIP)
    rig.sim.do(Mute(ids=(HIP,), instruction="tpdo1"))
    assert isinstance(moving.wait().error, DeviceSilent)


def test_a_drive_that_falls_silent_while_it_is_enabled_has_no_fault(rig: Leg) -> None:
    hip = _patient(rig).motor("leg.hip")
    rig.sim.do(Mute(ids=(HIP,), instruction="tpdo1"))
    with pytest.raises(DeviceSilent):
        hip.enable()


def _patient(rig: Leg) -> AttachedRobot:
    """It takes longer to be called silent here than a joint may stand on its way."""
    rig.configure(('channel = "can0"', 'channel = "can0"\nstale_after_s = 1.5'))
    rig.plug()
    return rig.attach()


def _strike(leg: Leg, fault: str) -> None:
    for order in ROWS[fault].strike:
        assert not isinstance(order, Sick)
        leg.sim.do(order)


def _set_up(leg: Leg, since: float) -> list[LogEntry]:
    """Frames that start the hip, with which a set-up ends."""
    return [entry for entry in leg.frames("nmt", since=since) if entry.data == bytes((1, HIP))]


def _is_silent(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except DeviceSilent:
        return True
    return False
