"""What goes wrong on a CAN bus: what the caller is told, what the others do, and that nothing moves when it is over."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from drivers.conftest import Outcome, written_now
from drivers.legs import HALT, HIP, KNEE, Leg, fault_of, leg, rig
from trade.errors import BusGone, DeviceError, DeviceFault, DeviceSilent, TradeError
from trade_hil_sim import (
    Absent,
    BadCrc,
    BrownOut,
    BusOff,
    Command,
    Duplicate,
    Emergency,
    Entry,
    Freeze,
    Heal,
    Jam,
    Late,
    Mute,
    Replug,
    Truncate,
    Unplug,
    WrongModel,
)
from waiting import wait_until

__all__ = ["leg", "rig"]


@dataclass
class Case:
    """One way to fail in the middle of a move of the hip."""

    name: str
    fault: Command
    error: type[TradeError]
    says: str
    """Part of what the mover is told."""
    back: str = ""
    """What the fault says that is latched once the drive is heard again, as a regular expression."""


AWAY = "it was away|it has not heard this driver"  # its own watchdog may have had its say as it came back
CASES = [
    Case("silence", Mute(ids=(HIP,)), DeviceSilent, "did not answer", "it was away"),
    Case("no measurements", Mute(ids=(HIP,), instruction="tpdo1"), DeviceSilent, "did not answer", "it was away"),
    Case("heartbeat lost", Mute(ids=(HIP,), instruction="heartbeat"), DeviceSilent, "did not answer", "it was away"),
    Case("cut short", Truncate(ids=(HIP,), instruction="tpdo1", missing=3), DeviceSilent, "did not answer", "away"),
    Case("off the bus", BusOff(ids=(HIP,)), DeviceSilent, "did not answer", AWAY),
    Case("cable off", Absent(ids=(HIP,)), DeviceSilent, "did not answer", AWAY),
    Case("frozen value", Freeze(ids=(HIP,)), DeviceFault, "it makes no progress", "it makes no progress"),
    Case("blocked", Jam(ids=(HIP,)), DeviceFault, "error 8611h, following error", "error 8611h"),
    Case("EMCY", Emergency(ids=(HIP,), code=0x4310), DeviceFault, "error 4310h, over-temperature", "error 4310h"),
    Case("restart", BrownOut(ids=(HIP,)), DeviceError, "", "it has restarted"),
    Case("adapter off the bus", BusOff(), BusGone, "bus-off: too many errors", AWAY),
    Case("adapter unplugged", Unplug(), BusGone, "", AWAY),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_fault_while_moving_ends_the_move_and_nothing_moves_on_recovery(leg: Leg, case: Case) -> None:
    hip = leg.attach().motor("leg.hip")
    moving = Outcome(lambda: hip.move_to(0.9, 0.3))
    started = leg.wait_for("motion_started", HIP)
    leg.sim.do(case.fault)
    error = moving.wait().error
    assert isinstance(error, case.error), error
    assert case.says in str(error)
    if case.error is DeviceSilent:
        axis = hip._axes[0]  # type: ignore[attr-defined]
        wait_until(lambda: axis.silent, "it is given up")
    mark = written_now()
    leg.sim.do(Heal())
    if isinstance(case.fault, Unplug):
        leg.sim.do(Replug())
    wait_until(lambda: (fault := fault_of(hip)) and re.search(case.back, fault), f"heard again: {case.back!r}")
    with pytest.raises(DeviceFault):
        hip.move_to(0.0)
    assert len(leg.goals(HIP)) == 1
    assert not [e for e in leg.events("motion_started", HIP, mark) if e.t > started.t]
    hip.enable()
    assert hip.move_to(0.0) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("case", [CASES[0], CASES[7], CASES[8]], ids=lambda case: case.name)
def test_a_fault_of_one_stops_the_others_of_its_group(leg: Leg, case: Case) -> None:
    group = leg.attach().group("leg")
    moving = Outcome(lambda: group.move_to([0.9, 0.9], 0.3))
    started = leg.wait_for("motion_started", KNEE)
    leg.sim.do(case.fault)
    assert isinstance(moving.wait().error, case.error)
    assert leg.wait_for("at_rest", KNEE, started.t)
    assert leg.controlwords(KNEE, started.t)[-1] & HALT


@pytest.mark.parametrize("fault", [case.fault for case in CASES[:6]], ids=[case.name for case in CASES[:6]])
def test_a_drive_that_is_not_heard_does_not_keep_the_others(leg: Leg, fault: Command) -> None:
    robot = leg.attach()
    hip, knee = robot.motor("leg.hip"), robot.motor("leg.knee")
    leg.sim.do(fault)
    wait_until(lambda: _is_silent(hip.state), "the hip is not heard")
    assert knee.move_to(0.3) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("fault", [CASES[1].fault, CASES[2].fault], ids=["no measurements", "no heartbeat"])
def test_a_drive_that_answers_but_is_not_heard_is_not_back_until_it_is(leg: Leg, fault: Command) -> None:
    hip = leg.attach().motor("leg.hip")
    axis = hip._axes[0]  # type: ignore[attr-defined]
    leg.sim.do(fault)
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
        BadCrc(ids=(HIP,), instruction="tpdo1", count=5),
        Duplicate(ids=(HIP,), instruction="tpdo1"),
        Late(ids=(HIP,), instruction="tpdo1", s=0.004),
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


def test_another_drive_in_its_place_is_refused(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    leg.sim.do(Absent(ids=(HIP,)))
    wait_until(lambda: _is_silent(hip.state), "it is not heard")
    leg.sim.do(WrongModel(ids=(HIP,), number=77))
    leg.sim.do(Absent(ids=(HIP,), on=False))
    hip_axis = hip._axes[0]  # type: ignore[attr-defined]
    wait_until(lambda: "another drive answers as node 1" in hip_axis.fault, "the other drive is found out")
    mark = written_now()
    with pytest.raises(DeviceError):
        hip.enable()
    assert not leg.frames("rpdo1", HIP, mark)


def test_S07_stop_of_a_drive_that_is_not_heard_says_so(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    leg.sim.do(Mute(ids=(HIP,)))
    wait_until(lambda: _is_silent(hip.state), "it is not heard")
    with pytest.raises(DeviceSilent):
        hip.stop()


def _set_up(leg: Leg, since: float) -> list[Entry]:
    """Frames that start the hip, with which a set-up ends."""
    return [entry for entry in leg.frames("nmt", since=since) if entry.data == bytes((1, HIP))]


def _is_silent(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except DeviceSilent:
        return True
    return False
