"""Clients within a container (S03): each moves for itself, and takes no other down with it."""

import threading
from collections.abc import Callable, Iterable, Iterator

import pytest

from tests.support.two_joint_robot import Joint, Robot
from tests.support.waiting import wait_until
from trade import Container, Handle, where
from trade._resources.resource import Resource, admit
from trade.errors import ConfigurationError, LockedByOther, LockLost, SessionEnded, Stopped
from trade.testing import MemorySystem, memory_system

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system() as made:
        yield made


@pytest.fixture
def robot(system: MemorySystem) -> Robot:
    return Robot(system)


def test_S03_what_a_client_moves_stops_with_it_and_nothing_of_another_one_does(robot: Robot) -> None:
    go_a, go_b = robot.find("a", "go_on"), robot.find("b", "go_on")
    one, two = robot.me.open_session("page"), robot.me.open_session("page")
    with one.use():
        go_a(1.0)
    with two.use():
        go_b(1.0)
    one.close()
    assert robot.joints["a"].stopped.wait(20)
    robot.system.settle()
    assert robot.joints["b"].resource.moving
    two.close()
    assert robot.joints["b"].stopped.wait(20)


def test_S03_what_the_container_moves_for_itself_is_none_of_its_clients(robot: Robot) -> None:
    go = robot.find("a", "go_on")
    go(1.0)
    with robot.me.open_session("page"):
        robot.find("b", "go_on")(1.0)
    assert robot.joints["b"].stopped.wait(20)
    assert robot.joints["a"].resource.moving


def test_S03_a_motion_in_the_clients_own_container_stops_with_it_too(robot: Robot) -> None:
    here = Joint("here")
    robot.me.register(here, "robot.here")
    with robot.me.open_session("page"):
        robot.find("here", "go_on")(1.0)
        assert here.resource.moving
    assert here.stopped.wait(20)


def test_S03_a_client_that_is_gone_moves_nothing_any_more(robot: Robot) -> None:
    move = robot.find("a")
    session = robot.me.open_session("page")
    session.close()
    session.close()
    with session.use(), pytest.raises(SessionEnded, match="Open another one"):
        move(1.0)
    assert robot.joints["a"].written == []


def test_S03_a_call_that_comes_after_the_end_of_its_session_is_refused(robot: Robot) -> None:
    """It was under way, or waited behind others, when the client went."""
    move, session = robot.find("a"), robot.me.open_session("page")
    with session.use():
        move(1.0)
    home = robot.system.container("a")
    home._parts.session_ended(session.name)
    with session.use(), pytest.raises(SessionEnded):
        move(2.0)
    assert robot.joints["a"].written == [1.0]


def test_S03_a_client_that_could_not_be_reached_moves_again_when_it_can_and_one_that_left_meanwhile_does_not(
    robot: Robot,
) -> None:
    go, one, two = robot.find("a", "go_on"), robot.me.open_session("one"), robot.me.open_session("two")
    with one.use():
        go(1.0)
    robot.system.partition("me", "a")
    robot.system.advance(2)
    assert robot.joints["a"].stopped.wait(20)
    two.close()
    robot.system.heal()
    robot.system.settle()
    go = robot.find("a", "go_on")
    with one.use():
        go(2.0)
    home = robot.system.container("a")._parts.locks
    assert home.session_error([one.name]) is None
    assert home.session_error([two.name]) is not None


def test_S03_of_two_clients_of_one_program_one_stops_the_other_only_for_a_reason(robot: Robot) -> None:
    go, stop = robot.find("a", "go_on"), robot.find("a", "stop")
    one, two = robot.me.open_session("one"), robot.me.open_session("two")
    with one.use():
        go(1.0)
    with two.use():
        stop()
    with one.use(), pytest.raises(Stopped):  # S08: a stop by another session latches
        go(1.0)
    robot.me.resume(where(group="robot.a"))
    with one.use():
        go(1.0)
        stop()
        go(1.0)


def test_a_clients_lock_is_not_its_neighbours_and_falls_with_it(robot: Robot) -> None:
    move = robot.find("a")
    one, two = robot.me.open_session("one"), robot.me.open_session("two")
    lost = threading.Event()
    with one.use():
        lock = robot.me.lock(where(group="robot.a"), on_lost=lambda _: lost.set()).acquire()
        with lock.use():
            move(1.0)
    with two.use(), pytest.raises(LockedByOther):
        move(2.0)
    one.close()
    wait_until(lambda: robot.me.locks() == [], "it fell")
    with two.use():
        move(3.0)
    assert lost.wait(20)
    with pytest.raises(LockLost, match="closed"), lock.use():
        move(4.0)


def test_a_session_goes_along_with_calls_that_are_not_waited_for(robot: Robot) -> None:
    joint = robot.joints["a"]
    joint.hold.clear()
    session = robot.me.open_session("page")
    with session.use():
        run = robot.find("a").start(1.0)
    assert joint.entered.wait(20)
    assert next(iter(joint.resource.calls.values())).sessions[0] == session.name
    session.close()
    assert joint.stopped.wait(20)
    joint.hold.set()
    with pytest.raises(Exception, match="stopped before its goal"):
        run.result(20)
    assert joint.written == []


def test_a_session_of_another_container_says_nothing_of_ones_own_calls(robot: Robot) -> None:
    with robot.other.open_session("page"):
        robot.find("a", "go_on")(1.0)
    robot.system.settle()
    assert robot.joints["a"].resource.moving


def test_no_session_of_a_closed_container(robot: Robot) -> None:
    robot.other.close()
    with pytest.raises(ConfigurationError, match="closed"):
        robot.other.open_session("page")


@pytest.mark.parametrize("how", ["own", "from elsewhere"])
def test_what_moves_is_stopped_before_its_services_are_withdrawn(robot: Robot, how: str) -> None:
    joint, home = robot.joints["a"], robot.system.container("a")
    robot.find("a", "go_on")(1.0)
    seen: list[bool] = []
    joint.stop, stop = lambda: (seen.append(home.client.has(key)), stop())[1], joint.stop  # type: ignore[method-assign]
    key = robot.find("a", "go_on").key
    home.alter(joint)
    withdraw: Callable[[], object] = lambda: home.deregister(joint)  # noqa: E731
    if how == "from elsewhere":
        withdraw = lambda: _system_of(robot.me, home, "deregister")(robot.find("a", "go_on"))  # noqa: E731
    withdraw()
    assert seen == [True]
    assert not joint.resource.moving


def test_what_cannot_be_stopped_is_not_withdrawn_from_elsewhere(robot: Robot) -> None:
    joint, home = robot.joints["a"], robot.system.container("a")
    robot.find("a", "go_on")(1.0)
    joint.stop_fails = True
    with pytest.raises(Exception, match="stop failed"):
        _system_of(robot.me, home, "deregister")(robot.find("a", "go_on"))
    assert robot.me.services(where(group="robot.a"))
    home.deregister(joint)  # its registering container has the last word
    robot.system.settle()
    assert not robot.me.services(where(group="robot.a"))


def test_a_motion_that_another_provider_can_still_stop_continues(robot: Robot) -> None:
    joint, home = robot.joints["a"], robot.system.container("a")
    twin = Joint("a")
    twin.resources = joint.resources
    home.register(twin, "robot.twin")
    robot.find("a", "go_on")(1.0)
    home.deregister(twin)
    assert joint.resource.moving
    assert not joint.stopped.is_set()


def test_S14_a_device_that_a_dead_session_could_not_stop_is_locked_only_after_resume(robot: Robot) -> None:
    joint = robot.joints["a"]
    joint.stop_fails = True
    with robot.me.open_session("page"):
        robot.find("a", "go_on")(1.0)
    wait_until(lambda: joint.resource.unsafe, "its stop failed")
    joint.resource.moving = False
    with pytest.raises(Exception, match="a"):
        robot.me.lock(where(group="robot.a"), wait_s=0).acquire()
    robot.me.resume(where(group="robot.a"))
    with robot.me.lock(where(group="robot.a"), wait_s=0):
        pass


def _system_of(me: Container, home: Container, name: str) -> Handle:
    return me.find(where(group="trade", name=name, container=home.name), wait_s=20)


def test_S05_a_call_that_is_being_admitted_is_not_of_the_session_that_moved_last() -> None:
    """The old session ends between two steps of an admission: what rests is not its motion any more."""
    joints = [Resource("a"), Resource("b")]
    moved = admit(joints, 1, "tester", (), ("old",), None)
    moved.close()
    during: list[frozenset[str]] = []

    def look(_: Iterable[str]) -> None:
        during.extend(joint.sessions for joint in joints if joint.busy)

    for joint in joints:
        joint.session_error = look
    admit(joints, 2, "tester", (), ("new",), None)
    assert during
    assert set().union(*during) == {"new"}


def test_S05_a_motion_without_a_call_is_of_the_session_that_began_it() -> None:
    joint = Resource("a")
    moved = admit([joint], 1, "tester", (), ("old",), None)
    joint.moving = True
    moved.close()
    assert joint.sessions == {"old"}
    joint.moving = False
    assert joint.sessions == set()
