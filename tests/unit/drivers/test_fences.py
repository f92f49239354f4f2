"""Locks, stops and sessions on a real bus: containers here, the judge is what the simulated servos received and did."""

import math
from collections.abc import Callable, Iterator

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig, goal_counts, written_now
from tests.unit.drivers.gate import Gate
from trade import Container, Handle, where
from trade.errors import IncompleteGroup, LockedByOther, LockLost, MotionStopped, Stopped
from trade_drivers import AttachedRobot, Motor

FAR_COUNTS = 2048 + 1.25 * 4096 / math.tau
"""Beyond this only a command to go there puts a goal; who holds, holds where the joint is."""


@pytest.fixture
def driver(start_container: Callable[..., Container]) -> Container:
    return start_container("driver")


@pytest.fixture
def robot(head: Rig, gate: Gate, driver: Container) -> Iterator[AttachedRobot]:
    from trade_drivers import attach

    ports = {"neck": str(head.sim.port)}
    with attach(head.robot, register=driver.register, deregister=driver.deregister, ports=ports, healthy=gate) as up:
        yield up


@pytest.fixture
def pan(robot: AttachedRobot) -> Motor:
    return robot.motor("neck.pan")


@pytest.fixture
def planner(start_container: Callable[..., Container], robot: AttachedRobot) -> Container:
    return start_container("planner")


@pytest.fixture
def operator(start_container: Callable[..., Container], robot: AttachedRobot) -> Container:
    return start_container("operator")


PAN = where(group="rosie.neck.pan")


def service(container: Container, name: str, group: str = "rosie.neck.pan") -> Handle:
    return container.find(where(name=name, group=group), wait_s=20).with_(deadline_s=60)


def far(head: Rig, since: float) -> list[int]:
    """Goals that only a command to go far puts."""
    return [goal_counts(entry) for entry in head.goals(1, since) if goal_counts(entry) > FAR_COUNTS]


# --- S11


def test_S11_a_command_admitted_under_a_lock_that_is_lost_never_reaches_the_wire(
    head: Rig, gate: Gate, pan: Motor, planner: Container, operator: Container
) -> None:
    pan.enable()
    move = service(planner, "move_to")
    lock = planner.lock(PAN).acquire()
    with lock.use():
        gate.hold_up()
        mark = written_now()
        run = move.start(1.3)
        wait_until(lambda: pan._exchange._inbox, "the move is admitted")  # type: ignore[attr-defined]
        assert operator.locking.break_lock(PAN, "it is mine")
        gate.let_go()
        with pytest.raises((LockLost, MotionStopped)):
            run.result()
        with pytest.raises(LockLost):
            move(1.3)
    lock.release()
    assert not far(head, mark)
    assert not head.events("motion_started", 1, mark)


def test_S11_a_set_point_ends_with_the_lock_it_was_admitted_under(head: Rig, pan: Motor, planner: Container) -> None:
    turn = service(planner, "set_velocity")
    with planner.lock(PAN):
        turn(0.3, 1.0)
        began = head.wait_for("motion_started", 1)
    rest = head.wait_for("at_rest", 1, began.t)
    held = next(entry for entry in head.goals(1, began.t) if goal_counts(entry) < FAR_COUNTS)
    assert held.t <= rest.t
    assert head.truth(1).position_rad < 0.3


def test_S11_who_has_no_lock_writes_nothing(head: Rig, pan: Motor, planner: Container, operator: Container) -> None:
    pan.enable()
    with planner.lock(where(group="rosie.head")):
        mark = written_now()
        for act in (
            lambda: service(operator, "move_to")(0.3),
            lambda: service(operator, "set_velocity")(0.3),
            service(operator, "enable"),
            lambda: service(operator, "servo", "rosie.head")([0.3, 0.3]),
            lambda: pan.move_to(0.3),  # a plain call of the method, without the middleware (S15)
        ):
            with pytest.raises(LockedByOther):
                act()
        assert service(operator, "state")().name == "rosie.neck.pan"
    assert not head.moves(since=mark)


# --- S13


def test_S13_a_lock_is_granted_once_what_was_left_moving_rests(
    head: Rig, pan: Motor, planner: Container, operator: Container
) -> None:
    service(planner, "set_velocity")(0.3, 1.0)
    with operator.lock(PAN, wait_s=30):
        assert not head.truth(1).moving
        assert head.events("motion_started", 1)


# --- S07, S08


def test_S08_a_foreign_stop_holds_until_somebody_resumes(
    head: Rig, pan: Motor, planner: Container, operator: Container
) -> None:
    move = service(planner, "move_to")
    run = move.start(1.3, 0.2)
    head.wait_for("motion_started", 1)
    service(operator, "stop")()
    with pytest.raises(MotionStopped):
        run.result()
    mark = written_now()
    for act in (lambda: move(1.3), lambda: service(operator, "move_to")(1.3), lambda: pan.move_to(1.3)):
        with pytest.raises(Stopped):
            act()
    assert not head.moves(since=mark)
    assert operator.locking.resume(PAN) == ["rosie.neck.pan"]
    assert move(0.1) == pytest.approx(0.1, abs=0.03)


def test_S08_ones_own_stop_does_not_hold(head: Rig, pan: Motor, planner: Container) -> None:
    move = service(planner, "move_to")
    run = move.start(1.3, 0.2)
    head.wait_for("motion_started", 1)
    service(planner, "stop")()
    with pytest.raises(MotionStopped):
        run.result()
    assert move(0.1) == pytest.approx(0.1, abs=0.03)


def test_S08_a_stop_reaches_what_is_held_up_in_the_queue(
    head: Rig, gate: Gate, pan: Motor, planner: Container, operator: Container
) -> None:
    pan.enable()
    gate.hold_up()
    mark = written_now()
    run = service(planner, "move_to").start(1.3)
    wait_until(lambda: pan._exchange._inbox, "the move is admitted")  # type: ignore[attr-defined]
    stop = service(operator, "stop").start()
    wait_until(lambda: pan._exchange._stops, "the stop is there")  # type: ignore[attr-defined]
    gate.let_go()
    stop.result()
    with pytest.raises(MotionStopped):
        run.result()
    assert not far(head, mark)
    assert not head.events("motion_started", 1, mark)


def test_S07_a_stop_needs_no_lock_and_only_the_owner_lets_it_move_again(
    head: Rig, pan: Motor, planner: Container, operator: Container
) -> None:
    with planner.lock(PAN):
        run = service(planner, "move_to").start(1.3, 0.2)
        head.wait_for("motion_started", 1)
        service(operator, "stop")()
        with pytest.raises(MotionStopped):
            run.result()
        assert head.truth(1).position_rad < 1.2
        with pytest.raises(LockedByOther):
            operator.locking.resume(PAN)
        with pytest.raises(Stopped):
            service(planner, "move_to")(0.1)
        assert planner.locking.resume(PAN) == ["rosie.neck.pan"]
        assert service(planner, "move_to")(0.1) == pytest.approx(0.1, abs=0.03)


def test_S05_a_motion_ends_with_its_session_whoever_else_used_the_joint_meanwhile(
    head: Rig, pan: Motor, planner: Container, operator: Container
) -> None:
    service(planner, "move_to").start(1.3, 0.2)
    began = head.wait_for("motion_started", 1)
    service(operator, "enable")()  # disturbs nothing
    planner.close()
    rest = head.wait_for("at_rest", 1, began.t)
    assert rest.position_rad is not None
    assert rest.position_rad < 1.2


def test_S08_ones_own_stop_does_not_hold_whoever_else_used_the_joint_meanwhile(
    head: Rig, pan: Motor, planner: Container, operator: Container
) -> None:
    move = service(planner, "move_to")
    run = move.start(1.3, 0.2)
    head.wait_for("motion_started", 1)
    service(operator, "enable")()
    service(planner, "stop")()
    assert isinstance(run.exception(20), MotionStopped)
    assert move(0.1) == pytest.approx(0.1, abs=0.03)


# --- S16


def test_S16_a_group_with_a_missing_member_is_not_locked(
    head: Rig, robot: AttachedRobot, driver: Container, planner: Container
) -> None:
    driver.deregister(robot.group("head"))
    driver.deregister(robot.motor("neck.tilt"))
    move = service(planner, "move_to")
    wait_until(lambda: not planner.services(where(name="move_to", group="rosie.neck.tilt")), "it is gone")
    for group in ("rosie", "rosie.neck"):
        with pytest.raises(IncompleteGroup) as refused:
            planner.lock(where(group=group)).acquire()
        assert refused.value.missing == ["rosie.neck.tilt"]
    with planner.lock(where(group="rosie"), partial=True):
        move(0.1)
    driver.register(robot.motor("neck.tilt"), ("rosie.neck.tilt",))
    driver.register(robot.group("head"), ("rosie.head",))


def test_S16_coupled_joints_are_locked_together(
    rig: Rig, driver: Container, start_container: Callable[..., Container]
) -> None:
    from trade_drivers import attach

    rig.configure(("[group.head]", '[[coupled]]\njoints = ["neck.pan", "neck.tilt"]\n[group.head]'))
    rig.plug()
    ports = {"neck": str(rig.sim.port)}
    with attach(rig.robot, register=driver.register, deregister=driver.deregister, ports=ports):
        planner, operator = start_container("planner"), start_container("operator")
        tilt = service(operator, "move_to", "rosie.neck.tilt")
        service(planner, "move_to")
        with planner.lock(PAN) as lock:
            assert lock.resources == ("rosie.neck.pan", "rosie.neck.tilt")
            with pytest.raises(LockedByOther):
                tilt(0.1)
        assert not rig.moves()
