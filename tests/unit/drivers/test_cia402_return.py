"""Drives that come back: they are looked over beside the cycle, by themselves, and nothing moves of it."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import can
import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, call, sleep_past, written_now
from tests.unit.drivers.legs import HIP, KNEE, LEG, Leg, fault_of, leg, rig, stop_by_nmt
from trade.errors import DeviceFault, DeviceSilent, TradeError
from trade_drivers import AttachedRobot, Motor, attach, parse
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import Stage
from trade_hil_sim import Absent, BrownOut, Heal, Late, LogEntry, Mute, SimProcess, events, frames

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]

SLOW_S = 0.03


def is_silent(motor: Motor) -> bool:
    try:
        motor.state()
    except DeviceSilent:
        return True
    except TradeError:
        return False
    return False


def syncs_of_a_move(leg: Leg, knee: Motor, goal_rad: float) -> int:
    """How many SYNCs the knee hears on its way."""
    mark = written_now()
    knee.move_to(goal_rad, 0.3)
    started, rest = leg.wait_for("motion_started", KNEE, mark), leg.wait_for("at_rest", KNEE, mark)
    return len([entry for entry in leg.frames("sync", since=started.t) if entry.t < rest.t])


def test_a_drive_that_is_looked_over_does_not_disturb_the_others_however_late_it_answers(rig: Leg) -> None:
    leg = rig
    leg.configure(('channel = "can0"', 'channel = "can0"\nwatchdog_s = 2'))  # a busy host is another matter
    leg.plug()
    robot = leg.attach()
    hip, knee = robot.motor("leg.hip"), robot.motor("leg.knee")
    undisturbed = syncs_of_a_move(leg, knee, 0.9)
    leg.sim.do(Absent(ids=(HIP,)))
    wait_until(lambda: is_silent(hip), "the hip is not heard")
    leg.sim.do(Late(ids=(HIP,), instruction="sdo_reply", s=SLOW_S))
    leg.sim.do(Absent(ids=(HIP,), on=False))
    mark = written_now()
    beside = syncs_of_a_move(leg, knee, 0.0)
    assert len(leg.frames("sdo_request", HIP, mark)) > 10  # it was looked over meanwhile
    assert beside > 0.7 * undisturbed
    wait_until(lambda: not is_silent(hip), "the hip is back")
    requests, syncs = leg.frames("sdo_request", HIP, mark), leg.frames("sync", since=mark)
    during = [entry for entry in syncs if requests[0].t < entry.t < requests[-1].t]
    assert len(during) > len(requests)
    assert not leg.events("watchdog_expired", KNEE)


def test_drives_are_fed_while_the_others_are_attached(rig: Leg) -> None:
    rig.plug()
    rig.sim.do(Late(instruction="sdo_reply", s=SLOW_S))
    rig.attach()
    requests = rig.frames("sdo_request", KNEE)
    assert [entry for entry in rig.frames("sync") if requests[0].t < entry.t < requests[-1].t]
    assert not rig.events("watchdog_expired")


def test_a_drive_that_restarts_while_it_is_looked_over_is_looked_over_from_the_beginning(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    leg.sim.do(Absent(ids=(HIP,)))
    wait_until(lambda: is_silent(hip), "the hip is not heard")
    leg.sim.do(Late(ids=(HIP,), instruction="sdo_reply", s=SLOW_S))
    mark = written_now()
    leg.sim.do(Absent(ids=(HIP,), on=False))
    wait_until(lambda: armings(leg, mark), "its watchdog is armed")
    restart = written_now()
    leg.sim.do(BrownOut(ids=(HIP,)))
    wait_until(lambda: not is_silent(hip), "the hip is back")
    assert armings(leg, restart)
    leg.sim.do(Heal())
    hip.enable()
    assert hip.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_a_drive_that_does_not_stay_started_is_started_again(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    axis = hip._axes[0]  # type: ignore[attr-defined]
    leg.sim.do(Mute(ids=(HIP,), instruction="tpdo1"))
    wait_until(lambda: axis.silent, "it is given up")
    mark = written_now()
    wait_until(lambda: armings(leg, mark) and axis.stage is Stage.SET_UP, "it is awaited")
    sent = written_now()
    with leg.listen() as other:
        other.send(can.Message(arbitration_id=0, data=bytes((table.NMT_PREOPERATIONAL, HIP)), is_extended_id=False))
        slept = leg.wait_for("nmt", HIP, sent)
        wait_until(lambda: leg.frames("nmt", since=slept.t)[-1].data == bytes((1, HIP)), "it is started again")
    leg.sim.do(Heal())
    wait_until(lambda: not is_silent(hip), "the hip is back")
    assert not armings(leg, sent)


def armings(leg: Leg, since: float) -> list[LogEntry]:
    """Requests that write whose heartbeat the hip is to listen for (1016h)."""
    return [frame for frame in leg.frames("sdo_request", HIP, since) if frame.data[:3] == b"\x23\x16\x10"]


def test_a_driver_that_was_held_up_does_not_take_its_drives_for_silent(
    rig: Leg, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.configure(('channel = "can0"', 'channel = "can0"\nwatchdog_s = 2'))
    rig.plug()
    robot = rig.attach()
    exchange = robot.motor("leg.hip")._exchange  # type: ignore[attr-defined]
    attached, cycle = len(rig.frames("nmt")), exchange.cycle
    rig.sim.do(Late(instruction="tpdo1", s=0.015))  # later than the cycle that asks waits for it
    held_up = threading.Event()

    def late_cycle() -> None:
        sleep_past(time.monotonic_ns() + 2 * exchange.stale_after_ns)
        monkeypatch.setattr(exchange, "cycle", cycle)
        cycle()
        held_up.set()

    monkeypatch.setattr(exchange, "cycle", late_cycle)
    wait_until(held_up.is_set, "the cycle was late")
    assert not any(axis.silent for axis in exchange.devices)
    wait_until(lambda: not is_silent(robot.motor("leg.hip")), "it was measured")
    assert robot.group("leg").move_to([0.1, 0.1]) == pytest.approx([0.1, 0.1], abs=0.01)
    assert len(rig.frames("nmt")) == attached


class Stand:
    """A simulated leg in a process of its own."""

    def __init__(self, undo: ExitStack, tmp_path: Path) -> None:
        self.file = tmp_path / "leg.toml"
        self.file.write_text(LEG)
        self.sim = undo.enter_context(SimProcess(self.file, paced=False))

    def events(self, name: str, since: float = 0.0) -> list[LogEntry]:
        return events(self.sim.entries(), name, since=since)

    def started(self, since: float = 0.0) -> set[int | None]:
        return {event.device_id for event in self.events("motion_started", since)}

    def goals(self, since: float) -> list[LogEntry]:
        return [entry for entry in frames(self.sim.entries(), "rpdo1", since=since) if entry.data[0] & 1 << 4]

    def freeze(self, pid: int, seconds: float) -> float:
        """Stop a process for so long; returns when it continues."""
        os.kill(pid, signal.SIGSTOP)
        try:
            sleep_past(int((written_now() + seconds) * 1e9))
        finally:
            mark = written_now()
            os.kill(pid, signal.SIGCONT)
        return mark


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    with ExitStack() as undo:
        yield Stand(undo, tmp_path)


@pytest.fixture
def robot(stand: Stand) -> Iterator[AttachedRobot]:
    ports = stand.sim.ports
    attached = attach(parse(LEG, "leg.toml"), announced=False, ports=ports)
    yield attached
    attached.close()


@pytest.mark.realtime
@pytest.mark.parametrize("seconds", [0.3, 1, 3])
def test_all_drives_come_back_by_themselves_from_a_silence_and_nothing_moves(
    stand: Stand, robot: AttachedRobot, seconds: float
) -> None:
    group, motors = robot.group("leg"), [robot.motor("leg.hip"), robot.motor("leg.knee")]
    moving = Outcome(lambda: group.move_to([0.9, 0.9], 0.2))
    wait_until(lambda: stand.started() == {HIP, KNEE}, "both move")
    mark = stand.freeze(stand.sim.pid, seconds)
    assert isinstance(moving.wait().error, TradeError)
    wait_until(lambda: all(fault_of(motor) for motor in motors), "both are heard again, and say why they stand")
    assert not stand.goals(mark)
    assert not stand.started(mark)
    for motor in motors:
        motor.enable()
    assert group.move_to([0.1, 0.1]) == pytest.approx([0.1, 0.1], abs=0.01)


@pytest.mark.realtime
@pytest.mark.parametrize("seconds", [0.3, 1, 3])
def test_a_driver_process_that_was_suspended_finds_its_drives_again_and_moves_nothing(
    stand: Stand, seconds: float
) -> None:
    script = str(Path(__file__).with_name("driver_process.py"))
    words = [sys.executable, script, str(stand.file), stand.sim.ports["legs"], "legs", "leg.hip"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "attached"
            wait_until(lambda: stand.started() == {HIP}, "the hip moves")
            mark = stand.freeze(process.pid, seconds)
            assert process.stdout.readline().startswith(("DeviceFault", "DeviceSilent", "moved"))
            assert not stand.goals(mark)
            for joint, number in (("leg.hip", HIP), ("leg.knee", KNEE)):
                reported = written_now()
                wait_until(lambda joint=joint: ask(process, f"{joint} 0.1") == "0.1", f"{joint} is moved")
                assert stand.started(reported) == {number}
        finally:
            process.kill()


def ask(process: "subprocess.Popen[str]", line: str) -> str:
    """Have the driver process do something; what it says then."""
    assert process.stdin is not None
    assert process.stdout is not None
    print(line, file=process.stdin, flush=True)
    return process.stdout.readline().strip()


@pytest.mark.realtime
def test_a_drive_that_network_management_has_stopped_says_so_and_enable_takes_it_back(
    leg: Leg, caplog: pytest.LogCaptureFixture
) -> None:
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    stop_by_nmt(leg, HIP)
    wait_until(lambda: hip._axes[0].silent, "it is left out")  # type: ignore[attr-defined]
    mark = written_now()
    for refused in (hip.state, lambda: hip.move_to(0.1)):
        with pytest.raises(DeviceFault, match=r"network management has stopped it.*call enable\(\)"):
            refused()
    assert not leg.frames("nmt", since=mark)  # no client has asked for it
    hip.enable()
    assert leg.frames("nmt", HIP, mark)[0].data == bytes((table.NMT_PREOPERATIONAL, HIP))
    assert [entry.message for entry in caplog.records if "put to pre-operational" in entry.message]
    assert not leg.events("motion_started", HIP, mark)
    assert hip.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_a_drive_found_stopped_is_taken_back_by_attaching(leg: Leg, caplog: pytest.LogCaptureFixture) -> None:
    leg.attach().close()
    stop_by_nmt(leg, HIP)
    mark = written_now()
    hip = leg.attach().motor("leg.hip")
    assert leg.frames("nmt", HIP, mark)[0].data == bytes((table.NMT_PREOPERATIONAL, HIP))
    assert not leg.frames("rpdo1", since=mark)
    assert [entry.message for entry in caplog.records if "put to pre-operational" in entry.message]
    hip.enable()
    assert hip.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_a_group_with_two_stopped_drives_is_enabled_although_a_frame_of_it_is_lost(leg: Leg) -> None:
    group = leg.attach().group("leg")
    for node in (HIP, KNEE):
        stop_by_nmt(leg, node)
    wait_until(lambda: all(axis.silent for axis in group._axes), "both are left out")  # type: ignore[attr-defined]
    leg.sim.do(Mute(ids=(KNEE,), instruction="nmt", count=1))
    with call(20.0):  # the lost frame alone takes half of the second that a call without a deadline has
        group.enable()
    assert group.move_to([0.1, 0.1]) == pytest.approx([0.1, 0.1], abs=0.01)
