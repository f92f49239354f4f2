"""Locks over containers, S11 to S17: all or nothing, carried by calls, renewed, lost as a whole."""

import asyncio
import contextvars
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from tests.support.two_joint_robot import WHOLE, Joint, Robot
from tests.support.waiting import wait_until
from trade import Container, Handle, errors, permit, service, where
from trade._locks import api
from trade._resources.grants import LockRequest
from trade.protocol.keys import ServiceKey
from trade.testing import memory_system

pytestmark = pytest.mark.virtual_time


def test_S13_services_of_several_containers_are_locked_together_or_not_at_all(robot: Robot) -> None:
    with robot.me.lock(WHOLE, purpose="walk") as lock:
        assert lock.resources == ("a", "b")
        assert (robot.find("a")(0.1), robot.find("b")(0.2)) == (0.1, 0.2)
        for name in "ab":
            with pytest.raises(errors.LockedByOther, match="is locked by tester/me for 'walk'") as refused:
                robot.find(name, whose=robot.other)(0.9)
            assert (refused.value.resources, refused.value.own) == ([name], False)
            assert refused.value.since > 0
    assert robot.find("a", whose=robot.other)(0.3) == 0.3
    with robot.other.lock(where(group="robot.b")):
        with pytest.raises(errors.LockedByOther), robot.me.lock(WHOLE, wait_s=0):
            pass
        assert robot.find("a", whose=robot.other)(0.4) == 0.4  # nothing of it stayed locked
    assert robot.me.locks() == []


def test_a_lock_is_only_held_once_it_is_whole(robot: Robot) -> None:
    lock = robot.me.lock(where(group="nothing.there"), wait_s=0)
    with pytest.raises(errors.NoSuchService):
        lock.acquire()
    assert not lock.held
    with pytest.raises(errors.ConfigurationError, match="a lock is taken once"):
        lock.acquire()


def test_containers_whose_locks_are_unknown_are_reported(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asleep = threading.Event()
    with robot.me.lock(WHOLE):
        monkeypatch.setattr(robot.system.container("a")._parts.locks, "infos", lambda: asleep.wait(60) and [])
        monkeypatch.setattr(api, "_ANSWER_S", 0.2)
        assert [info.resources for info in robot.other.locks()] == [("b",)]
        asleep.set()
    assert "the locks in tester/a are not known" in caplog.text


def test_P51_how_a_lock_is_used_is_seen_from_elsewhere(robot: Robot) -> None:
    def seen() -> dict[str, tuple[int, float]]:
        return {info.resources[0]: (info.uses, info.last_use) for info in robot.other.locks()}

    with robot.me.lock(WHOLE):
        assert seen() == {"a": (0, 0.0), "b": (0, 0.0)}
        for _ in range(2):
            robot.find("a")(0.1)
        with pytest.raises(errors.LockedByOther):
            robot.find("b", whose=robot.other)(0.9)
        used = seen()
        assert (used["a"][0], used["b"]) == (2, (0, 0.0))
        robot.find("a")(0.2)
        assert seen()["a"][1] > used["a"][1] > 0.0
    with robot.me.lock(WHOLE):
        assert seen() == {"a": (0, 0.0), "b": (0, 0.0)}


@pytest.mark.parametrize("where_it_is", ["local", "remote"])
def test_S15_a_started_call_carries_the_locks_around_it(robot: Robot, where_it_is: str) -> None:
    """Also the first one to a container, which has to ask for its clock before."""
    me = robot.system.container("a" if where_it_is == "local" else "fresh")
    handle = robot.find("a", whose=me)
    with me.lock([handle]):
        assert handle.start(0.5).result(20) == 0.5


def test_S15_the_first_started_call_under_a_lock_of_elsewhere_carries_it(robot: Robot) -> None:
    fresh = robot.system.container("fresh")
    handle, unasked = robot.find("a", whose=fresh), robot.find("b", whose=fresh)
    with fresh.lock([handle, unasked]):
        peer = fresh._parts.caller.peer(unasked.key.address)
        peer._low_ns, peer._high_ns = -math.inf, math.inf  # as if it had never been heard
        assert unasked.start(0.5).result(20) == 0.5


def test_S15_another_thread_needs_use_and_the_refusal_says_so(robot: Robot) -> None:
    handle, outcomes = robot.find("a"), list[Any]()

    def without() -> None:
        try:
            handle(0.1)
        except errors.LockedByOther as error:
            outcomes.append(error)

    def with_use() -> None:
        with lock.use():
            outcomes.append(handle(0.2))

    with robot.me.lock([handle]) as lock:
        for what in (without, with_use):
            thread = threading.Thread(target=what)
            thread.start()
            thread.join(20)
    assert outcomes[0].own
    assert "Make the call inside `with lock.use():`" in str(outcomes[0])
    assert outcomes[1] == 0.2


def test_async_with_and_its_tasks(robot: Robot) -> None:
    handle = robot.find("a")

    async def main() -> list[float]:
        async with robot.me.lock([handle]):
            results = await asyncio.gather(handle.acall(0.1), handle.acall(0.2))
            with pytest.raises(errors.LockedByOther):
                await robot.find("a", whose=robot.other).acall(0.3)
        await robot.find("a", whose=robot.other).acall(0.4)
        return results

    assert asyncio.run(main()) == [0.1, 0.2]


def test_a_cancelled_async_with_leaves_nothing_locked(robot: Robot) -> None:
    async def main() -> None:
        async with robot.me.lock(WHOLE, wait_s=30):
            raise AssertionError("it cannot be had")

    async def cancelled() -> None:
        task = asyncio.create_task(main())
        await asyncio.to_thread(wait_until, lambda: any(info.waiting for info in robot.me.locks()))
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        taken.release()

    taken = robot.other.lock(WHOLE).acquire()
    asyncio.run(cancelled())
    wait_until(lambda: robot.me.locks() == [])


def test_the_locks_around_a_task_are_forgotten_even_if_giving_back_is_cancelled(robot: Robot) -> None:
    from trade._context.outgoing import holding

    async def main() -> None:
        lock = robot.me.lock(WHOLE)
        try:
            async with lock:
                asyncio.current_task().cancel()  # type: ignore[union-attr]
        except asyncio.CancelledError:
            assert holding.get() == ()
            wait_until(lambda: robot.other.locks() == [])

    asyncio.run(main())


class Relay:
    """A provider that uses the joint on behalf of its callers."""

    def __init__(self, joint: Handle) -> None:
        self._joint = joint
        self.later: Callable[[], Any] = lambda: None
        self.plain: Callable[[], Any] | None = None

    @service
    def pass_on(self, value: float) -> float:
        context = contextvars.copy_context()
        self.later = lambda: context.run(self._joint, value)
        return self._joint(value)

    @service
    def call_plainly(self) -> None:
        assert self.plain is not None
        self.plain()


def relay(robot: Robot, identity: str = "tester") -> tuple[Relay, Handle]:
    between = robot.system.container("between", identity=identity)
    provider = Relay(robot.find("a", whose=between))
    between.register(provider, "relay")
    return provider, robot.me.find(where(name="pass_on"), wait_s=20)


def test_S15_nested_calls_inherit_while_the_parent_runs_and_no_longer(robot: Robot) -> None:
    provider, pass_on = relay(robot)
    with robot.me.lock([robot.find("a")]):
        assert pass_on(0.1) == 0.1
        with pytest.raises(errors.LockedByOther):
            provider.later()


def test_S15_a_lock_is_used_by_delegates_only(robot: Robot) -> None:
    _, pass_on = relay(robot, identity="servant")
    with robot.me.lock([robot.find("a")]), pytest.raises(errors.LockedByOther):
        pass_on(0.1)
    with robot.me.lock([robot.find("a")], delegates=["servant"]):
        assert pass_on(0.2) == 0.2


def test_S15_a_plain_python_call_has_no_lock_even_on_behalf_of_its_owner(robot: Robot) -> None:
    provider, _ = relay(robot)
    provider.plain = lambda: robot["a"].move(0.5)
    with robot.me.lock([robot.find("a")]), pytest.raises(errors.LockedByOther):
        robot.me.find(where(name="call_plainly"), wait_s=20)()
    robot["a"].move(0.5)


def test_S15_a_thread_that_a_provider_leaves_running_has_no_permit_any_more() -> None:
    class Lingering(Joint):
        later: Callable[[], None]

        @service
        def linger(self) -> None:
            context = contextvars.copy_context()
            self.later = lambda: context.run(self.write)

        def write(self) -> None:
            with permit(self.resources) as permitted:
                permitted.gate()

    with memory_system() as system:
        joint, me = Lingering(), system.container("me")
        system.container("there").register(joint, "robot")
        linger = me.find(where(name="linger"), wait_s=20)
        with me.lock([linger]):
            linger()
            with pytest.raises(errors.LockedByOther):
                joint.later()


def test_request_release_reaches_the_owner(robot: Robot) -> None:
    heard = list[tuple[str, str]]()
    reported = threading.Event()

    def on_request(who: str, reason: str) -> None:
        heard.append((who, reason))
        reported.set()

    with robot.me.lock(WHOLE, on_request=on_request):
        assert set(robot.other.request_release(WHOLE, "the door")) == {"tester/me"}
        assert reported.wait(20)
    assert ("tester/other", "the door") in heard
    assert robot.other.request_release(WHOLE, "again") == []


def test_P52_of_two_waiting_clients_the_one_with_the_higher_priority_comes_first(robot: Robot) -> None:
    turns = list[str]()

    def take(whose: Container, priority: int) -> None:
        with whose.lock(WHOLE, wait_s=60, priority=priority):
            turns.append(whose.name)

    waiting = list[threading.Thread]()
    with robot.me.lock(WHOLE):
        for name, priority in (("low", -1), ("middle", 0), ("high", 1)):
            waiting.append(threading.Thread(target=take, args=(robot.system.container(name), priority)))
            waiting[-1].start()
            wait_until(lambda: len(robot.other.locks()[0].waiting) == len(waiting))
    for thread in waiting:
        thread.join(60)
    assert turns == ["high", "middle", "low"]


def test_two_clients_that_want_the_same_locks_in_opposite_order_both_get_them(robot: Robot) -> None:
    turns = list[str]()

    def take(container: Container, names: str) -> None:
        handles = [robot.find(name, whose=container) for name in names]
        for _ in range(20):
            with container.lock(handles, wait_s=60):
                turns.append(container.name)

    threads = [threading.Thread(target=take, args=pair) for pair in ((robot.me, "ab"), (robot.other, "ba"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert sorted(turns) == ["me"] * 20 + ["other"] * 20


def test_S13_a_waiting_lock_renews_the_parts_that_it_already_holds(robot: Robot) -> None:
    taken = robot.other.lock([robot.find("b", whose=robot.other)], lease_s=60).acquire()
    lock = robot.me.lock(WHOLE, wait_s=60, lease_s=1.0)
    waiting = threading.Thread(target=lock.acquire)
    waiting.start()
    wait_until(lambda: any(info.waiting for info in robot.other.locks()))  # it has a, and waits for b
    part = next(info for info in robot.other.locks() if info.resources == ("a",))
    first = dict(lock._confirmed)
    wait_until(lambda: lock._confirmed.keys() == first.keys() and min(lock._confirmed.values()) > max(first.values()))
    assert part.token in [info.token for info in robot.other.locks()]
    taken.release()
    waiting.join(60)
    assert lock.held
    lock.release()


def test_S13_a_nested_lock_does_not_wait_for_its_own_callers(robot: Robot) -> None:
    class Careful(Joint):
        def __init__(self, container: Container) -> None:
            super().__init__("c")
            self._container = container

        @service
        def twice(self) -> float:
            with self._container.lock(where(name="move", group="careful"), wait_s=0):
                return self._container.find(where(name="move", group="careful"))(0.7)

    home = robot.system.container("careful")
    home.register(Careful(home), "careful")
    assert robot.me.find(where(name="twice"), wait_s=20)() == 0.7


def test_re_entry_takes_nothing_twice_and_gives_nothing_back_early(robot: Robot) -> None:
    with robot.me.lock(WHOLE) as outer:
        with robot.me.lock([robot.find("a")], wait_s=0) as inner:
            assert inner.held
            assert robot.find("a")(0.1) == 0.1
        assert outer.held
        with pytest.raises(errors.LockedByOther):
            robot.find("a", whose=robot.other)(0.2)


class _Walker:
    """A service that takes locks, or looks for services, as far as its caller's deadline lets it."""

    def __init__(self, container: Container) -> None:
        self._container = container

    @service
    def walk(self) -> None:
        with self._container.lock(WHOLE, purpose="walk"):
            pass

    @service
    def walk_what_is_not_there(self) -> None:
        with self._container.lock(where(group="nothing.there")):
            pass

    @service
    def look_for(self, name: str) -> None:
        self._container.find(where(name=name), wait_s=60)


@pytest.fixture
def walker(robot: Robot) -> Callable[[str], Handle]:
    home = robot.system.container("walker")
    home.register(_Walker(home), "walker")
    return lambda name: robot.me.find(where(name=name, group="walker"), wait_s=20).with_(deadline_s=1.5)


def test_S13_a_lock_wait_in_a_service_fails_before_the_deadline_of_its_call(
    robot: Robot, walker: Callable[[str], Handle]
) -> None:
    """By default a lock waits as long as a call lasts: its owner and purpose are reported all the same."""
    refused = pytest.raises(errors.LockedByOther, match="is locked by tester/other for 'dance'")
    with robot.other.lock(WHOLE, purpose="dance"), refused:
        walker("walk")()
    assert robot.me.locks() == []


def test_a_direct_lock_request_to_a_container_is_answered_in_time(robot: Robot) -> None:
    """As containers in other languages do, whose wait may be the deadline of the call."""
    acquire = ServiceKey(robot.find("a").key.address, "trade", "system", "acquire")
    with robot.other.lock(WHOLE, purpose="dance"), pytest.raises(errors.LockedByOther, match="for 'dance'"):
        robot.me.handle(acquire).with_(deadline_s=1.5)(["a"], LockRequest(wait_s=1.5))


def test_a_service_that_waits_in_vain_fails_before_the_deadline_of_its_call(
    walker: Callable[[str], Handle],
) -> None:
    with pytest.raises(errors.NoSuchService, match=r"nothing\.there"):
        walker("walk_what_is_not_there")()
    with pytest.raises(errors.NoSuchService, match="not_there"):
        walker("look_for")("not_there")


class _Eye:
    @service(effect="read")
    def image(self) -> bytes:
        return b""


def test_a_single_handle_is_refused_with_what_to_write_instead(robot: Robot) -> None:
    handle: Any = robot.find("a")
    with pytest.raises(errors.ConfigurationError, match=r"lock\(\[handle\]\)"):
        robot.me.lock(handle).acquire()


def test_S16_an_empty_selection_locks_nothing(robot: Robot) -> None:
    for nothing in ([], where(group="robot", name="where_is_it")):
        with pytest.raises(errors.ConfigurationError):
            robot.me.lock(nothing).acquire()


def test_S16_a_lock_of_an_unknown_group_suggests_a_known_group(robot: Robot) -> None:
    with pytest.raises(errors.NoSuchService, match="Did you mean robot") as refused:
        robot.me.lock(where(group="robt"), wait_s=0).acquire()
    assert robot.me.locks() == []
    assert not isinstance(refused.value, errors.ConfigurationError)


def test_S16_a_lock_waits_until_its_group_is_complete(robot: Robot) -> None:
    head = robot.system.container("head")
    joints = [Joint(name) for name in ("pan", "tilt")]
    for joint in joints:
        joint.members = {"rosie.head": ("pan", "tilt")}  # type: ignore[attr-defined]
    lock = robot.me.lock(where(group="rosie.head"), wait_s=20)
    with ThreadPoolExecutor(1) as waiting:
        taken = waiting.submit(lock.acquire)
        wait_until(lambda: bool(robot.me._parts.registry._changed._gates), "it waits")
        head.register(_Eye(), "rosie.head")
        head.register(joints[0], "rosie.head")
        robot.me.find(where(group="rosie.head", name="move"), wait_s=20)  # a part of it is seen, and not taken
        assert robot.me.locks() == []
        assert not taken.done()
        head.register(joints[1], "rosie.head")
        taken.result(20)
        assert lock.resources == ("pan", "tilt")
        lock.release()


def test_S16_a_lock_of_an_incomplete_group_names_the_missing_member_at_its_timeout(robot: Robot) -> None:
    joint, head = Joint("pan"), robot.system.container("head")
    joint.members = {"rosie.head": ("pan", "tilt")}  # type: ignore[attr-defined]
    lock = robot.me.lock(where(group="rosie.head"), wait_s=1)
    with ThreadPoolExecutor(1) as waiting:
        taken = waiting.submit(lock.acquire)
        wait_until(lambda: bool(robot.me._parts.registry._changed._gates), "it waits")
        head.register(joint, "rosie.head")
        with pytest.raises(errors.IncompleteGroup, match="tilt"):
            taken.result(20)
    assert robot.me.locks() == []


def test_S16_a_lock_taken_while_its_driver_leaves_waits_for_the_next_one(robot: Robot) -> None:
    def joints() -> list[Joint]:
        pair = [Joint(name) for name in ("pan", "tilt")]
        for joint in pair:
            joint.members = {"rosie.head": ("pan", "tilt")}  # type: ignore[attr-defined]
        return pair

    old, new = robot.system.container("old"), robot.system.container("new")
    leaving = joints()
    for joint in leaving:
        old.register(joint, "rosie.head")
    old.deregister(leaving[0])  # as its container closes: one after the other
    wait_until(lambda: len(robot.me.services(where(group="rosie.head", name="move"))) == 1, "a part is left")
    lock = robot.me.lock(where(group="rosie.head"), wait_s=20)
    with ThreadPoolExecutor(1) as waiting:
        taken = waiting.submit(lock.acquire)
        wait_until(lambda: bool(robot.me._parts.registry._changed._gates), "it waits")
        old.deregister(leaving[1])
        wait_until(lambda: not robot.me.services(where(group="rosie.head")), "nothing is left")
        for joint in joints():
            new.register(joint, "rosie.head")
        taken.result(20)
    assert lock.resources == ("pan", "tilt")
    lock.release()


def test_S16_an_incomplete_group_is_refused_unless_a_part_will_do(robot: Robot) -> None:
    joint = Joint("pan")
    joint.members = {"rosie.head": ("pan", "tilt")}  # type: ignore[attr-defined]
    robot.system.container("head").register(joint, "rosie.head")
    robot.me.find(where(group="rosie.head", name="move"), wait_s=20)
    with pytest.raises(errors.IncompleteGroup, match="tilt"):
        robot.me.lock(where(group="rosie")).acquire()
    with robot.me.lock(where(group="rosie"), partial=True) as lock:
        assert lock.resources == ("pan",)


def test_S17_reading_stays_open_unless_it_is_locked_by_its_handle(robot: Robot) -> None:
    read, mine = robot.find("a", "where_is_it", robot.other), robot.find("a", "where_is_it")
    with robot.me.lock(WHOLE):
        assert read() == 0.0
    with robot.me.lock([mine]):
        assert mine() == 0.0
        with pytest.raises(errors.LockedByOther):
            read()


def test_each_client_may_stop(robot: Robot) -> None:
    with pytest.raises(errors.ConfigurationError, match="cannot be locked"):
        robot.me.lock([robot.find("a", "stop")]).acquire()
    with robot.me.lock(WHOLE):
        robot.find("a", "stop", robot.other)()
    assert robot["a"].stopped.is_set()


def test_a_container_that_closes_under_its_locks_closes_without_an_error(robot: Robot) -> None:
    lock = robot.me.lock(WHOLE, lease_s=60).acquire()
    robot.me.close()
    assert not lock.held
    wait_until(lambda: robot.other.locks() == [])
