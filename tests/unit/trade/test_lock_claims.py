"""A lock with a constraint holds a part of each alternative, says what, and lets nothing else of it be commanded."""

import threading
import time
from typing import Any
from unittest.mock import Mock

import pytest

from tests.support.two_joint_robot import Joint, Robot
from tests.support.waiting import PATIENCE_S
from tests.unit.trade.lock_table_rig import Table
from trade import Handle, service, where
from trade._locks import api
from trade._locks.remote_locks import RemoteLocks, SharedResource
from trade._resources.grants import LockRequest
from trade.errors import IncompleteGroup, LockLost, NotLocked
from trade.protocol.keys import Address

pytestmark = pytest.mark.virtual_time

A, B, C = (where(group=f"robot.{name}") for name in "abc")


def comes(robot: Robot, name: str) -> Joint:
    """A joint's driver starts."""
    joint = robot.joints[name] = Joint(name)
    robot.system.container(name).register(joint, f"robot.{name}")
    robot.system.settle()
    return joint


def test_S13_a_union_of_which_an_alternative_is_missing_is_not_locked_in_part(robot: Robot) -> None:
    with pytest.raises(IncompleteGroup, match=r"group='robot\.c' missing") as refused:
        robot.me.lock(A | C, wait_s=0).acquire()
    assert refused.value.missing == ["group='robot.c'"]
    assert robot.me.locks() == []


def test_S13_an_alternative_of_which_nothing_moves_is_missing(robot: Robot) -> None:
    class Eye:
        @service(effect="read")
        def image(self) -> bytes:
            return b""

    robot.system.container("c").register(Eye(), "robot.c")
    robot.system.settle()
    with pytest.raises(IncompleteGroup, match=r"group='robot\.c'"):
        robot.me.lock(A | C, wait_s=0).acquire()


def test_S13_a_lock_waits_for_an_alternative_that_comes(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api, "_SETTLE_S", PATIENCE_S)  # on a busy computer it comes late
    came = threading.Timer(0.2, comes, (robot, "c"))
    came.start()
    with robot.me.lock(A | C) as lock:
        assert (lock.resources, lock.missing) == (("a", "c"), ())
    came.join(20)


def test_S13_what_an_alternative_leaves_out_is_no_alternative_of_its_own(robot: Robot) -> None:
    """``not (group b and name move)`` is ``not group b, or not name move``, of which the second matches nothing."""
    with robot.me.lock(where(group="robot", name="move") & ~where(group="robot.b", name="move")) as lock:
        assert lock.resources == ("a",)


@pytest.fixture(params=["call", "start", "use", "inherited", "nested"])
def command(request: pytest.FixtureRequest, robot: Robot) -> Any:
    """Ways to make a call under a lock."""

    def call(_: Any, handle: Handle) -> object:
        return handle(0.9)

    def start(_: Any, handle: Handle) -> object:
        return handle.start(0.9).result(20)

    def use(lock: Any, handle: Handle) -> object:
        outcomes: list[Any] = []

        def apart() -> None:
            try:
                with lock.use():
                    outcomes.append(handle(0.9))
            except Exception as error:  # noqa: BLE001 - it is raised below
                outcomes.append(error)

        thread = threading.Thread(target=apart)
        thread.start()
        thread.join(20)
        if isinstance(outcomes[0], Exception):
            raise outcomes[0]
        return outcomes[0]

    def nested(_: Any, handle: Handle) -> object:
        relay = robot.me.find(where(name="relay", container="me"))
        return relay(handle)

    def inherited(lock: Any, handle: Handle) -> object:
        from trade._context.outgoing import handed_down
        from trade._locks.inherited import VARIABLE, InheritedLock

        passed = InheritedLock(lock.environment()[VARIABLE], robot.other.address)
        theirs = robot.other.find(where(name=handle.name, container=handle.container), wait_s=20)
        handed_down[robot.other.address] = passed
        try:
            return theirs(0.9)
        finally:
            del handed_down[robot.other.address]

    class Relay:
        @service(effect="note")
        def relay(self, handle: Handle) -> float:
            return handle(0.9)

    robot.me.register(Relay(), "relays")
    ways = {"call": call, "start": start, "use": use, "inherited": inherited, "nested": nested}
    return ways[request.param]


def test_a_partial_lock_reports_what_it_holds_and_what_is_missing(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    with robot.me.lock(A | C, partial=True, purpose="dance") as lock:
        assert repr(lock) == "<Lock of a, held, without group='robot.c'>"
    assert "the lock for 'dance' holds a; missing: group='robot.c'" in caplog.text


def test_S13_what_a_lock_selects_and_does_not_hold_is_not_commanded_under_it(robot: Robot, command: Any) -> None:
    with robot.me.lock(A | C, partial=True) as lock:
        assert (lock.resources, lock.missing) == (("a",), ("group='robot.c'",))
        joint = comes(robot, "c")
        handle = robot.find("c")
        with pytest.raises(NotLocked, match=r"robot\.c\.move.*Release the lock and take it again"):
            command(lock, handle)
        assert joint.written == []
        assert command(lock, robot.find("a")) == 0.9  # what it holds
        assert robot.find("c", "where_is_it")() == 0.0  # every client may read and stop
        robot.find("c", "stop")()
        with robot.me.lock([handle]):
            assert handle(0.4) == 0.4  # another one around holds it
    assert handle(0.5) == 0.5


def test_S13_what_comes_to_a_group_after_it_was_locked_is_not_commanded_under_that_lock(robot: Robot) -> None:
    with robot.me.lock(where(group="robot")):
        joint = comes(robot, "c")
        with pytest.raises(NotLocked):
            robot.find("c")(0.9)
        assert joint.written == []


def test_a_lock_of_handles_says_nothing_of_others(robot: Robot) -> None:
    with robot.me.lock([robot.find("a")]) as lock:
        assert (lock.missing, robot.find("b")(0.9)) == ((), 0.9)


def test_a_lost_lock_says_that_it_is_lost(robot: Robot) -> None:
    with pytest.raises(LockLost), robot.me.lock(A | B):
        robot.other.break_lock(A, "test")
        robot.find("a")(0.1)


def test_locks_in_several_systems_share_the_time_that_the_request_may_wait() -> None:
    patience = list[float]()

    class Lender:
        """Another system, in which a lock takes two seconds."""

        def lock(self, _call: object, _wanted: object, terms: LockRequest, *_: object) -> Mock:
            patience.append(terms.wait_s)
            time.sleep(2.0)
            return Mock()

    address = Address("tester", "home", "1")
    resources = [SharedResource(f"arm{number}", address, "arm", Lender()) for number in range(3)]  # type: ignore[arg-type]
    table = Table()
    try:
        with RemoteLocks(table.table, "1").acquire(Mock(), resources, LockRequest(wait_s=3.0), Mock()) as remote_lock:
            assert remote_lock.waited_s == pytest.approx(6.0, abs=0.1)
    finally:
        table.close()
    assert patience == pytest.approx([3.0, 1.0, 0.0], abs=0.1)
