"""Locks, stops and sessions over every vendor, through containers; the judge is what the devices received and did."""

from typing import Any

import pytest

import trade
from tests.contract.rigs.base import SafetyRig
from tests.contract.rigs.joints import JointRig
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.gate import Gate
from trade import Container, errors, where


def test_S11_a_command_admitted_under_a_lock_that_is_lost_never_reaches_the_wire(
    shared: SafetyRig, gate: Gate, planner: Container, operator: Container
) -> None:
    shared.ready()
    device, move = where(group=shared.resource), shared.service(planner, shared.far[0])
    lock = planner.lock(device).acquire()
    with lock.use():
        gate.hold_up()
        mark = written_now()
        run = move.start(*shared.far[1:])
        wait_until(lambda: shared.exchange._inbox, "the move is admitted")
        assert operator.lock_api.break_lock(device, "it is mine")
        gate.release()
        with pytest.raises((errors.LockLost, errors.MotionStopped)):
            run.result()
        with pytest.raises(errors.LockLost):
            move(*shared.far[1:])
    lock.release()
    assert not shared.sent_away(mark)
    assert not shared.events("motion_started", mark)


def test_S11_a_moving_device_gets_no_further_set_points_once_its_lock_is_lost(
    shared: SafetyRig, planner: Container, operator: Container
) -> None:
    device = where(group=shared.resource)
    shared.ready()
    lock = planner.lock(device).acquire()
    with lock.use():
        run = shared.started(planner, shared.slowly)
        shared.under_way()
        assert operator.lock_api.break_lock(device, "it is mine")
        with pytest.raises(errors.TradeError):
            run.result()
    lock.release()
    shared.rests()
    shared.judge_ended()


def test_S11_a_set_point_ends_with_the_lock_it_was_admitted_under(shared: SafetyRig, planner: Container) -> None:
    with planner.lock(where(group=shared.resource)):
        shared.asked(planner, shared.set_point)
        wait_until(lambda: shared.moving, "it moves")
    shared.rests()
    shared.judge_ended()
    assert shared.travelled() < shared.drift


def test_S11_a_client_without_the_lock_writes_nothing(
    shared: SafetyRig, planner: Container, operator: Container
) -> None:
    shared.ready()
    with planner.lock(where(group=shared.resource.rpartition(".")[0])):
        mark = written_now()
        for act in (*shared.requests(operator), *shared.commands()):  # the last ones are plain calls of methods (S15)
            with pytest.raises(errors.LockedByOther):
                act()
        assert shared.asked(operator, ("state",)).name == shared.resource
        assert not shared.ordered(mark)
        assert shared.moves_back(planner)


def test_S13_a_lock_is_granted_once_devices_that_still_move_are_at_rest(
    shared: SafetyRig, planner: Container, operator: Container
) -> None:
    mark = written_now()
    shared.asked(planner, shared.set_point)
    with operator.lock(where(group=shared.resource), wait_s=30):
        assert shared.at_rest()
        assert shared.events("motion_started", mark)


def test_S13_a_device_that_comes_after_its_group_was_locked_is_sent_nothing_under_that_lock(
    rig: SafetyRig, gate: Gate, driver: Container, planner: Container
) -> None:
    """A lock over a robot and a lamp, while the robot's driver is away."""

    class Lamp:
        @trade.service
        def light(self) -> None: ...

    group = rig.resource.rpartition(".")[0]
    either = where(group=group) | where(group="lamp")
    driver.register(Lamp(), "lamp")
    planner.find(where(group="lamp"), wait_s=20)
    with pytest.raises(errors.IncompleteGroup, match=rf"group='{group}' missing"):
        planner.lock(either, wait_s=0).acquire()
    rig.patient()
    with planner.lock(either, partial=True):
        rig.attach(register=driver.register, deregister=driver.deregister, healthy=gate)
        rig.asked(planner, ("state",))
        mark = written_now()
        for request in (rig.readying, rig.far):
            with pytest.raises(errors.NotLocked):
                rig.asked(planner, request)
        assert not rig.commanded(mark)
        rig.asked(planner, ("stop",))
    with planner.lock(either):
        rig.asked(planner, rig.readying)
        assert rig.moves_back(planner)


@pytest.fixture
def run(shared: SafetyRig, planner: Container) -> Any:
    """A move that the planner has started, under way."""
    shared.ready()
    made = shared.started(planner, shared.slowly)
    shared.under_way()
    return made


@pytest.mark.usefixtures("run")
def test_S05_a_motion_ends_with_its_session_despite_use_by_another_client(
    shared: SafetyRig, planner: Container, operator: Container
) -> None:
    shared.asked(operator, shared.harmless)
    planner.close()
    shared.rests()
    shared.judge_ended()


def test_S07_a_stop_needs_no_lock_and_only_the_owner_lets_it_move_again(
    shared: SafetyRig, planner: Container, operator: Container
) -> None:
    shared.ready()
    device = where(group=shared.resource)
    with planner.lock(device):
        run = shared.started(planner, shared.slowly)
        shared.under_way()
        shared.asked(operator, ("stop",))
        with pytest.raises(errors.MotionStopped):
            run.result()
        shared.rests()
        with pytest.raises(errors.LockedByOther):
            operator.lock_api.resume(device)
        with pytest.raises(errors.Stopped):
            shared.asked(planner, shared.far)
        assert planner.lock_api.resume(device) == [shared.resource]
        assert shared.moves_back(planner)


def test_S08_a_foreign_stop_latches_until_a_client_resumes(
    shared: SafetyRig, run: Any, planner: Container, operator: Container
) -> None:
    shared.asked(operator, ("stop",))
    with pytest.raises(errors.MotionStopped):
        run.result()
    mark = written_now()
    for request in (shared.far, shared.readying):
        for client in (planner, operator):
            with pytest.raises(errors.Stopped):
                shared.asked(client, request)
    with pytest.raises(errors.Stopped):
        shared.move()
    assert not shared.ordered(mark)
    assert operator.lock_api.resume(where(group=shared.resource)) == [shared.resource]
    assert shared.moves_back(planner)


@pytest.mark.parametrize("used_by_another", [False, True])
def test_S08_a_stop_by_the_owner_does_not_latch(
    shared: SafetyRig, run: Any, planner: Container, operator: Container, used_by_another: bool
) -> None:
    if used_by_another:
        shared.asked(operator, shared.harmless)
    shared.asked(planner, ("stop",))
    assert isinstance(run.exception(20), errors.MotionStopped)
    assert shared.moves_back(planner)


def test_S08_a_stop_voids_commands_that_wait_in_the_queue(
    shared: SafetyRig, gate: Gate, planner: Container, operator: Container
) -> None:
    shared.ready()
    gate.hold_up()
    mark = written_now()
    run = shared.started(planner, shared.far)
    wait_until(lambda: shared.exchange._inbox, "the move is admitted")
    stop = shared.started(operator, ("stop",))
    wait_until(lambda: shared.exchange._stops, "the stop is admitted")
    gate.release()
    stop.result()
    with pytest.raises(errors.MotionStopped):
        run.result()
    assert not shared.sent_away(mark)
    assert not shared.events("motion_started", mark)


def test_S16_a_group_with_a_missing_member_is_not_locked(
    shared: JointRig, driver: Container, planner: Container
) -> None:
    second = f"rosie.{shared.second}"
    driver.deregister(shared.robot.group(shared.group))
    driver.deregister(shared.robot.motor(shared.second))
    shared.service(planner, "move_to")
    wait_until(lambda: not planner.services(where(name="move_to", group=second)), "it is gone")
    for group in ("rosie", shared.resource.rpartition(".")[0]):
        with pytest.raises(errors.IncompleteGroup) as refused:
            planner.lock(where(group=group)).acquire()
        assert refused.value.missing == [second]
    with planner.lock(where(group="rosie"), partial=True):
        assert shared.moves_back(planner)
    driver.register(shared.robot.motor(shared.second), (second,))
    driver.register(shared.robot.group(shared.group), (f"rosie.{shared.group}",))


def test_S16_coupled_joints_are_locked_together(
    rig: JointRig, driver: Container, planner: Container, operator: Container
) -> None:
    group, second = f"[group.{rig.group}]", f"rosie.{rig.second}"
    rig.configure((group, f'[[coupled]]\njoints = ["{rig.joint}", "{rig.second}"]\n{group}'))
    rig.attach(register=driver.register, deregister=driver.deregister)
    move = rig.service(operator, "move_to", second)
    rig.service(planner, "move_to")
    with planner.lock(where(group=rig.resource)) as lock:
        assert lock.resources == (rig.resource, second)
        with pytest.raises(errors.LockedByOther):
            move(0.1)
    assert not rig.commanded()


def test_S20_a_second_driver_on_the_port_is_refused_and_sends_not_one_byte(rig: SafetyRig, gate: Gate) -> None:
    rig.patient()
    rig.attach(healthy=gate)
    rig.ready()
    gate.hold_up()
    mark = written_now()
    with pytest.raises(errors.ConfigurationError, match="another driver owns this port") as refused:
        rig.bench.attach()
    assert str(rig.bench.sim.port) in str(refused.value)
    assert not rig.heard(mark)
    gate.release()
    moving = rig.set_off()
    with pytest.raises(errors.ConfigurationError, match="another driver owns this port"):
        rig.bench.attach()
    assert moving.wait().error is None
    assert rig.travelled() == pytest.approx(1.0, abs=0.01)
