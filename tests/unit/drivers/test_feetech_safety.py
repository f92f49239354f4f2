"""The motion rules on Feetech servos, by their numbers; the judge is what the simulated servos received and did.

They have no watchdog: what S06 asks of the device is missing, and these tests show what the driver does instead.
"""

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
from tests.support.simulated_robots import TAIL
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, call, sleep_past, written_now
from tests.unit.drivers.gate import Gate
from tests.unit.drivers.tail_rig import COUNTS_PER_RAD, TailRig, goal_of, tail_rig
from trade.errors import DeadlineExceeded, DeviceFault, DeviceSilent, InvalidArgument, LimitExceeded, MotionStopped
from trade_drivers import AttachedRobot
from trade_hil_sim import Entry, events, received
from trade_hil_sim.feetech import Servo

LEAD_S = 0.3
SLOWLY_RAD_S = 0.3
NEAR = 20
"""Counts that a joint is sent ahead at least."""


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.let_go()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[TailRig]:
    with tail_rig(tmp_path) as made:
        yield made


@pytest.fixture
def tail(rig: TailRig) -> TailRig:
    rig.plug()
    return rig


def lead_counts(speed_rad_s: float, accel_rad_s2: float = 20.0) -> float:
    """How far ahead of a measurement a joint may be sent: what it takes until it has to be heard again, and braking."""
    return max(NEAR, (speed_rad_s * LEAD_S + speed_rad_s**2 / (2 * accel_rad_s2)) * COUNTS_PER_RAD) + 2


def measured_before(log: list[Entry], write: Entry) -> int:
    """The position that the servo had last told of when this write came."""
    told = [entry for entry in log if entry.kind == "sent" and entry.device_id == write.device_id]
    told = [entry for entry in told if entry.name == "sync_read" and entry.t <= write.t]
    return int.from_bytes(told[-1].data[5:7], "little")


# --- S01 late is never


@pytest.mark.parametrize("command", ["move_to", "enable", "relax"])
def test_S01_a_command_that_expires_while_the_bus_is_held_up_is_never_written(
    tail: TailRig, gate: Gate, command: str
) -> None:
    root = tail.root(healthy=gate)
    act: dict[str, Callable[[], object]] = {
        "move_to": lambda: root.move_to(0.5),
        "enable": root.enable,
        "relax": root.relax,
    }
    gate.hold_up()
    mark = written_now()
    late = Outcome(act[command], deadline_s=0.05)
    with call(0.05) as expires_ns:
        sleep_past(expires_ns)
    gate.let_go()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not tail.moves(since=mark)


# --- S06 the device has no watchdog: what a driver leaves behind


class Child:
    """A driver in a process of its own that moves the joint slowly."""

    def __init__(self, rig: TailRig, tmp_path: Path) -> None:
        file = tmp_path / "tail.toml"
        file.write_text(TAIL)
        program = str(Path(__file__).with_name("driver_process.py"))
        self.process = subprocess.Popen(
            [sys.executable, program, str(file), str(rig.sim.port), "tail", "tail.root"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.line() == "attached"

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def child(tail: TailRig, tmp_path: Path) -> Iterator[Child]:
    made = Child(tail, tmp_path)
    yield made
    made.close()


def test_S06_no_servo_has_a_watchdog_so_no_goal_is_farther_ahead_than_the_joint_gets_until_the_next(
    tail: TailRig,
) -> None:
    root = tail.root()
    root.enable()
    mark = written_now()
    root.move_to(1.2, 1.0)
    log, told = tail.log, tail.goals(1, mark)
    assert len(told) > 10
    for write in told:
        assert abs(goal_of(write) - measured_before(log, write)) <= lead_counts(1.0)


def test_S06_nor_is_one_of_a_set_point(tail: TailRig) -> None:
    root = tail.root()
    root.enable()
    mark = written_now()
    root.set_velocity(0.5, 1.0)
    tail.wait_for("at_rest", 1, mark)
    log = tail.log
    told = [write for write in tail.goals(1, mark) if write.name == "sync_write"]
    assert all(abs(goal_of(write) - measured_before(log, write)) <= lead_counts(0.5) for write in told)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill -9", "SIGSTOP"])
def test_S06_a_driver_process_that_dies_or_freezes_leaves_the_joint_where_it_was_sent_last_and_that_is_near(
    tail: TailRig, child: Child, number: int
) -> None:
    wait_until(lambda: tail.truth().position_rad > 0.05, "it is under way")
    child.signal(number)
    tail.wait_for("at_rest", 1)
    log, last = tail.log, tail.goals(1)[-1]
    assert tail.truth().position_counts == goal_of(last)
    assert goal_of(last) - measured_before(log, last) <= lead_counts(0.1)
    assert tail.truth().position_rad < 1.2


def test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why(tail: TailRig, child: Child) -> None:
    tail.wait_for("motion_started", 1)
    child.signal(signal.SIGSTOP)
    rested = tail.wait_for("at_rest", 1)
    where = tail.truth().position_counts
    threading.Event().wait(LEAD_S)
    child.signal(signal.SIGCONT)
    assert "DeviceFault" in (said := child.line())
    assert "held up" in said
    assert abs(tail.truth().position_counts - where) <= 1
    assert not [entry for entry in tail.goals(1, rested.t) if abs(goal_of(entry) - where) > 1]


def test_S06_an_unhealthy_process_holds_once_and_falls_silent(tail: TailRig, gate: Gate) -> None:
    root = tail.root(healthy=gate)
    moving = Outcome(lambda: root.move_to(1.3, SLOWLY_RAD_S))
    wait_until(lambda: tail.truth().position_rad > 0.1, "it is under way")
    gate.says = False
    assert moving.wait().error is not None
    wait_until(lambda: not tail.truth().moving, "it rests")
    held = tail.goals(1)[-1]
    assert abs(goal_of(held) - tail.truth().position_counts) <= 1
    with pytest.raises(DeviceFault, match="not healthy"):
        root.enable()
    assert not received(tail.log, since=held.t + 0.01)


# --- S07, S08 stop


def test_S07_a_stop_waits_for_one_exchange_at_most_although_a_joint_is_silent(tail: TailRig) -> None:
    root = tail.root()
    moving = Outcome(lambda: root.move_to(1.3, 0.1))
    tail.wait_for("motion_started", 1)
    seen = len(trade_hil_sim.instructions(tail.log))
    tail.sim.do(trade_hil_sim.Mute(ids=(2,)))
    wait_until(lambda: len(trade_hil_sim.instructions(tail.log)) > seen + 1, "the bus waits for the silent joint")
    asked = written_now()
    root.stop()
    written = next(entry for entry in tail.goals(1, asked) if goal_of(entry) < 2048 + 1.2 * COUNTS_PER_RAD)
    before = [entry.name for entry in trade_hil_sim.instructions(tail.log, since=asked) if entry.t < written.t]
    assert len(before) <= 1, before
    assert isinstance(moving.wait().error, MotionStopped)


def test_S08_a_command_admitted_before_a_stop_is_dropped_after_it(tail: TailRig, gate: Gate) -> None:
    root = tail.root(healthy=gate)
    root.enable()
    gate.hold_up()
    mark = written_now()
    resting = tail.truth().position_counts
    moving = Outcome(lambda: root.move_to(0.5))
    wait_until(lambda: root._exchange._inbox, "the move is admitted")  # type: ignore[attr-defined]
    stopping = Outcome(root.stop)
    wait_until(lambda: root._exchange._stops, "the stop is admitted")  # type: ignore[attr-defined]
    gate.let_go()
    assert isinstance(moving.wait().error, MotionStopped)
    stopping.wait()
    assert all(abs(goal_of(entry) - resting) <= 1 for entry in tail.goals(1, mark))
    assert not tail.events("motion_started", 1, mark)


def test_S08_a_stop_holds_where_the_joint_is_and_nothing_leads_it_on(tail: TailRig) -> None:
    root = tail.root()
    moving = Outcome(lambda: root.move_to(1.3, 1.0))
    wait_until(lambda: tail.truth().position_rad > 0.3, "it is under way")
    root.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    stopped, rest = written_now(), tail.truth().position_counts
    assert rest < 2048 + 1.2 * COUNTS_PER_RAD
    seen = len(trade_hil_sim.instructions(tail.log, "sync_read"))
    wait_until(lambda: len(trade_hil_sim.instructions(tail.log, "sync_read")) > seen + 15, "it goes on reading")
    assert not tail.goals(1, stopped)
    assert tail.truth().position_counts == rest


def test_S08_a_stop_of_a_relaxed_joint_sends_it_no_goal(tail: TailRig) -> None:
    """Some say that a goal switches the torque of these servos on."""
    robot = tail.attach()
    robot.motor("tail.root").stop()
    robot.group("tail").stop()
    assert not tail.moves()


# --- S18 attach moves and resets nothing


def test_S18_attaching_writes_nothing_at_all(tail: TailRig) -> None:
    tail.attach()
    assert not trade_hil_sim.writes(tail.log)


def test_S18_attaching_to_enabled_servos_writes_nothing_either(rig: TailRig) -> None:
    rig.plug(prepare=lambda sim: [servo.write(40, b"\1", written_now()) for servo in sim.devices] and None)
    assert rig.root().state().enabled
    assert not trade_hil_sim.writes(rig.log)


def test_S18_what_is_found_moving_is_stopped(rig: TailRig) -> None:
    rig.plug()
    rig.poke(40, 1)
    rig.poke(41, 20, *(3900).to_bytes(2, "little"), 0, 0, *(200).to_bytes(2, "little"))
    rig.wait_for("motion_started", 1)
    rig.attach()
    rig.wait_for("at_rest", 1)
    assert rig.truth().position_counts < 3800
    assert abs(goal_of(rig.goals(1)[-1]) - rig.truth().position_counts) <= 3
    assert not rig.goals(2)


def test_S18_enabling_seeds_the_goal_with_the_measured_position_before_torque_goes_on(tail: TailRig) -> None:
    root = tail.root()
    tail.sim.do(trade_hil_sim.Place(ids=(1,), counts=2400))
    root.enable()
    goal, torque = tail.moves(1)
    assert (goal_of(goal), "torque_enable" in goal.registers) == (2400, False)
    assert torque.registers == ("torque_enable",)
    assert tail.truth().position_counts == 2400
    assert not tail.events("motion_started", 1)


def test_S18_replugging_never_enables_and_never_commands(tail: TailRig) -> None:
    robot = tail.attach()
    robot.motor("tail.root").move_to(0.3)
    mark = written_now()
    tail.sim.do(trade_hil_sim.Unplug())
    wait_until(lambda: _is_silent(robot), "the driver noticed")
    tail.sim.do(trade_hil_sim.Replug())
    wait_until(lambda: not _is_silent(robot), "the driver is back")
    assert not tail.moves(since=mark)


# --- S19 leaving, S22 limits


@pytest.mark.parametrize("leave", ["hold", "relax"])
def test_S19_leaving_holds_or_relaxes_as_the_robot_file_says_and_moves_nothing(rig: TailRig, leave: str) -> None:
    rig.configure(('driver = "feetech"', f'driver = "feetech"\nleave = "{leave}"'))
    rig.plug()
    with rig.attach() as robot:
        robot.motor("tail.root").move_to(0.3)
        mark = written_now()
    assert rig.truth().torque == (leave == "hold")
    assert not rig.goals(since=mark)


@pytest.mark.parametrize(
    ("value", "error"), [(1.401, LimitExceeded), (-7.0, LimitExceeded), (math.nan, InvalidArgument)]
)
def test_S22_a_goal_outside_is_refused_and_nothing_is_sent(tail: TailRig, value: float, error: type[Exception]) -> None:
    root = tail.root()
    with pytest.raises(error):
        root.move_to(value)
    with pytest.raises(LimitExceeded):
        root.move_to(0.1, 0.01)  # slower than the slowest that is told from standing
    assert not tail.moves()


def test_S22_a_move_back_inside_is_allowed_from_outside(rig: TailRig) -> None:
    rig.plug(Servo(1, position_counts=2048 + 1100), Servo(2))
    assert rig.root().move_to(1.0) == pytest.approx(1.0, abs=0.03)
    assert len(events(rig.log, "motion_started", device_id=1)) == 1


def _is_silent(robot: AttachedRobot) -> bool:
    try:
        robot.motor("tail.root").state()
    except DeviceSilent:
        return True
    return False
