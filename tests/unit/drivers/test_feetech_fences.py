"""Locks on a bus of Feetech servos: what was admitted under a grant goes no farther than the grant."""

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.gate import Gate
from tests.unit.drivers.tail_rig import COUNTS_PER_RAD, TailRig, goal_of, tail_rig
from trade import Container, where
from trade.errors import ConfigurationError, LockedByOther, LockLost, MotionStopped, TradeError
from trade_drivers import Motor, attach

ROOT = where(group="rosie.tail.root")


@pytest.fixture
def tail(tmp_path: Path) -> Iterator[TailRig]:
    with tail_rig(tmp_path) as rig:
        rig.configure(('driver = "feetech"', 'driver = "feetech"\nstale_after_s = 1'))  # a busy machine is no silence
        rig.plug()
        yield rig


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.let_go()


@pytest.fixture
def root(tail: TailRig, gate: Gate, start_container: Callable[..., Container]) -> Iterator[Motor]:
    driver = start_container("driver")
    ports = {"tail": str(tail.sim.port)}
    with attach(tail.robot, register=driver.register, deregister=driver.deregister, ports=ports, healthy=gate) as up:
        yield up.motor("tail.root")


@pytest.fixture
def planner(root: Motor, start_container: Callable[..., Container]) -> Container:
    return start_container("planner")


@pytest.fixture
def operator(root: Motor, start_container: Callable[..., Container]) -> Container:
    return start_container("operator")


def test_S11_a_command_admitted_under_a_lock_that_is_lost_never_reaches_the_wire(
    tail: TailRig, gate: Gate, root: Motor, planner: Container, operator: Container
) -> None:
    root.enable()
    move = planner.find(where(name="move_to", group="rosie.tail.root"), wait_s=20).with_(deadline_s=60)
    here = tail.truth().position_counts
    lock = planner.lock(ROOT).acquire()
    with lock.use():
        gate.hold_up()
        mark = written_now()
        run = move.start(1.3)
        wait_until(lambda: root._exchange._inbox, "the move is admitted")  # type: ignore[attr-defined]
        assert operator.locking.break_lock(ROOT, "it is mine")
        gate.let_go()
        with pytest.raises((LockLost, MotionStopped)):
            run.result()
    lock.release()
    assert not [entry for entry in tail.goals(1, mark) if abs(goal_of(entry) - here) > 1]
    assert not tail.events("motion_started", 1, mark)


def test_S11_a_joint_on_its_way_is_led_on_no_more_once_its_lock_is_lost(
    tail: TailRig, root: Motor, planner: Container, operator: Container
) -> None:
    move = planner.find(where(name="move_to", group="rosie.tail.root"), wait_s=20).with_(deadline_s=60)
    lock = planner.lock(ROOT).acquire()
    with lock.use():
        run = move.start(1.3, 0.2)
        wait_until(lambda: tail.truth().position_rad > 0.1, "it is under way")
        assert operator.locking.break_lock(ROOT, "it is mine")
        with pytest.raises(TradeError):
            run.result()
    lock.release()
    tail.wait_for("at_rest", 1)
    assert all(goal_of(entry) < 2048 + 1.2 * COUNTS_PER_RAD for entry in tail.goals(1))


def test_S11_the_bus_thread_itself_leads_on_only_under_the_live_grant(tail: TailRig, root: Motor) -> None:
    root.enable()
    moving = Outcome(lambda: root.move_to(1.3, 0.2))
    wait_until(lambda: tail.truth().position_rad > 0.1 or moving.error, "it is under way")

    def gone() -> None:
        raise LockedByOther(resources=["rosie.tail.root"], owner="another")

    [axis] = root._axes  # type: ignore[attr-defined]
    axis.motion.permit = SimpleNamespace(gate=gone)
    assert isinstance(moving.wait().error, LockedByOther)
    mark = written_now()
    tail.wait_for("at_rest", 1)
    assert all(goal_of(entry) <= tail.truth().position_counts + 1 for entry in tail.goals(1, mark))


def test_S11_who_has_no_lock_writes_nothing(
    tail: TailRig, root: Motor, planner: Container, operator: Container
) -> None:
    move = operator.find(where(name="move_to", group="rosie.tail.root"), wait_s=20).with_(deadline_s=60)
    with planner.lock(ROOT), pytest.raises(LockedByOther):
        move(0.5)
    assert not tail.moves()


# --- S05, S20


def test_S05_a_motion_ends_with_its_session_whoever_else_used_the_joint_meanwhile(
    tail: TailRig, root: Motor, planner: Container, operator: Container
) -> None:
    planner.find(where(name="move_to", group="rosie.tail.root"), wait_s=20).start(1.3, 0.2)
    began = tail.wait_for("motion_started", 1)
    operator.find(where(name="enable", group="rosie.tail.root"), wait_s=20)()  # disturbs nothing
    planner.close()
    tail.wait_for("at_rest", 1, began.t)
    assert all(goal_of(entry) < 2048 + 1.2 * COUNTS_PER_RAD for entry in tail.goals(1))


def test_S20_a_second_driver_on_the_port_is_refused_and_sends_not_one_byte(tail: TailRig, gate: Gate) -> None:
    first = tail.root(healthy=gate)
    first.enable()
    gate.hold_up()
    mark = written_now()
    with pytest.raises(ConfigurationError, match="another driver owns this port") as refused:
        tail.attach()
    assert str(tail.sim.port) in str(refused.value)
    assert not [entry for entry in tail.log if entry.direction == "in" and entry.t >= mark]
    gate.let_go()
    moving = Outcome(lambda: first.move_to(0.5, 0.5))
    tail.wait_for("motion_started", 1, mark)
    with pytest.raises(ConfigurationError, match="another driver owns this port"):
        tail.attach()
    assert moving.wait().result == pytest.approx(0.5, abs=0.01)
