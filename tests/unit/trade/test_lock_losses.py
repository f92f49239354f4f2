"""Locks that are lost, and what moved under them: S08, S12 and S14."""

import threading
import traceback
from collections.abc import Callable, Sequence

import pytest

from tests.support.two_joint_robot import WHOLE, Joint, Robot
from tests.support.waiting import wait_until
from trade import Handle, errors, where
from trade._locks.lease_client import _FRESH_S
from trade._resources.grants import Granted, LockRequest
from trade._resources.resource import Latch
from trade.protocol.keys import Address
from trade.transport.zenoh import configuration

pytestmark = pytest.mark.virtual_time


class Losses:
    def __init__(self) -> None:
        self.reported: list[errors.LockLost] = []

    def __call__(self, lost: errors.LockLost) -> None:
        self.reported.append(lost)


class Frozen:
    """The client is frozen right before it reads the answer to its request for one joint."""

    def __init__(self, robot: Robot, monkeypatch: pytest.MonkeyPatch, meanwhile: Callable[[], None]) -> None:
        keeper, self._meanwhile, self.renewed = robot.me.lock_api.lease_client, meanwhile, 0
        ask, service_of = keeper._ask, keeper._service

        def then_frozen(address: Address, names: Sequence[str], terms: LockRequest) -> Callable[[], Granted]:
            bound = ask(address, names, terms)

            def answered() -> Granted:
                granted = bound()
                self._meanwhile()
                return granted

            return answered

        def counted(address: Address, name: str) -> Handle:
            self.renewed += name == "renew"
            return service_of(address, name)

        monkeypatch.setattr(keeper, "_ask", then_frozen)
        monkeypatch.setattr(keeper, "_service", counted)


@pytest.mark.parametrize("ended_s", [1.75, 5.0])
def test_S12_a_grant_that_ended_while_its_client_was_frozen_makes_no_lock(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, ended_s: float
) -> None:
    """Its lease has not ended, but its session has, and another client has the joint: only a renewal shows that."""
    table = robot.system.container("a")._parts.locks
    next_owner = robot.other.lock([robot.find("a", whose=robot.other)], wait_s=20, lease_s=60)

    def meanwhile() -> None:
        robot.system.advance(ended_s)
        [info] = table.infos()
        table.session_ended(info.holder.session, "its link is lost")
        next_owner.acquire()

    Frozen(robot, monkeypatch, meanwhile)
    lock = robot.me.lock([robot.find("a")], wait_s=20, lease_s=60)
    with pytest.raises(errors.LockLost, match="its link is lost"):
        lock.acquire()
    assert not lock.held
    assert next_owner.held
    next_owner.release()


@pytest.mark.parametrize(("frozen_s", "renewals"), [(0.5, 0), (1.5, 1)])
def test_S12_a_grant_is_renewed_before_it_counts_if_its_answer_was_read_late(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, frozen_s: float, renewals: int
) -> None:
    frozen = Frozen(robot, monkeypatch, lambda: robot.system.advance(frozen_s))
    with robot.me.lock([robot.find("a")], lease_s=60) as lock:
        assert lock.held
        assert frozen.renewed == renewals
        assert robot.find("a")(0.5) == 0.5


def test_S12_no_session_of_a_client_ends_as_long_as_its_grant_counts_as_fresh() -> None:
    """A link ends a lease after the last sign of life, and that may be one period older than the request."""
    settings = configuration(namespace="lab", listen=[], connect=[])
    lease_ms = settings["transport/link/tx/lease"]
    assert lease_ms - lease_ms / settings["transport/link/tx/keep_alive"] > 1000 * _FRESH_S


@pytest.mark.parametrize("victim", ["a", "b"])
def test_S14_a_member_that_dies_loses_the_whole_and_the_rest_stops(robot: Robot, victim: str) -> None:
    losses, rest = Losses(), "b" if victim == "a" else "a"
    with pytest.raises(errors.LockLost), robot.me.lock(WHOLE, lease_s=60, on_lost=losses) as lock:
        robot.find(rest, "go_on")(0.1)
        handle = robot.find(rest)
        robot.system.kill(victim)
        assert robot[rest].stopped.wait(20)
        wait_until(lambda: losses.reported)
        assert not lock.held
        with pytest.raises(errors.LockLost, match=f"container {victim} has ended"):
            handle(0.2)
    assert robot[rest].written == []
    wait_until(lambda: robot.other.locks() == [])


def test_S14_a_dead_owner_is_noticed_and_what_it_moved_stops(robot: Robot) -> None:
    robot.me.lock(WHOLE, lease_s=60).acquire()
    with robot.me.lock_api.lease_client._guard:
        locks = list(robot.me.lock_api.lease_client._locks)
    with locks[0].use():
        robot.find("a", "go_on")(0.1)
    robot.system.kill("me")
    assert robot["a"].stopped.wait(20)
    assert not robot["b"].stopped.is_set()
    with robot.other.lock(WHOLE, wait_s=20):
        assert robot.find("b", whose=robot.other)(0.3) == 0.3


def test_S12_a_partition_ends_the_lock_on_both_sides(robot: Robot) -> None:
    losses = Losses()
    lock = robot.me.lock(WHOLE, lease_s=60, on_lost=losses).acquire()
    robot.system.partition("me", "a")
    robot.system.advance(2)
    wait_until(lambda: losses.reported)
    assert not lock.held
    with robot.other.lock(WHOLE, wait_s=20):
        robot.system.heal()
        robot.system.settle()
        with lock.use(), pytest.raises(errors.LockLost):
            robot.find("b")(0.5)
    assert robot["b"].written == []


def test_S12_on_waking_locks_that_could_not_be_renewed_are_lost_before_anything_runs(
    robot: Robot,
) -> None:
    lock, handle = robot.me.lock([robot.find("a")], lease_s=60).acquire(), robot.find("a")
    before = robot.system.sent()
    lock._confirmed = {address: at - 60 for address, at in lock._confirmed.items()}
    with lock.use(), pytest.raises(errors.LockLost, match="could not be renewed within its lease"):
        handle(0.1)
    assert robot["a"].written == []
    assert robot.system.sent() - before <= 2  # its release and the answer, no call


def test_S12_a_short_lease_is_renewed_in_time_beside_a_long_one(robot: Robot) -> None:
    with robot.me.lock([robot.find("a")], lease_s=60), robot.me.lock([robot.find("b")], lease_s=1.0) as short:
        first = short._confirmed.copy()
        wait_until(lambda: all(short._confirmed[address] > first[address] for address in first))
        assert short.held


def test_renewals_continue_after_one_to_a_container_that_left(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    keeper, gone = robot.me.lock_api.lease_client, []
    real = keeper._service

    def service_of(address: Address, name: str) -> Handle:
        if name == "renew" and address.container == "a":
            gone.append(address)
            raise errors.ServiceGone(service="renew")
        return real(address, name)

    monkeypatch.setattr(keeper, "_service", service_of)
    kept = robot.me.lock([robot.find("b")], lease_s=1.0).acquire()
    doomed = robot.me.lock([robot.find("a")], lease_s=1.0).acquire()
    wait_until(lambda: gone and not doomed.held)
    first = kept._confirmed.copy()
    wait_until(lambda: all(kept._confirmed[address] > first[address] for address in first))
    kept.release()


def test_a_renewal_that_was_under_way_says_nothing_of_what_was_taken_since(robot: Robot) -> None:
    """It asks for the number of a part that was given back, and taken again under another one."""
    keeper, lock = robot.me.lock_api.lease_client, robot.me.lock([robot.find("a")], lease_s=60).acquire()
    [(address, token)] = lock.granted.items()
    keeper._renewed(address, [(lock, token.number - 1)], 0.0, _Answered([]))
    assert lock.held
    lock.release()
    keeper._renewed(address, [(lock, token.number)], 0.0, _Answered([token.number]))


class _Answered:
    def __init__(self, live: list[int]) -> None:
        self._live = live

    def result(self, _: float) -> list[int]:
        return self._live


def test_a_part_lost_while_waiting_for_the_rest_makes_no_lock(robot: Robot) -> None:
    taken = robot.other.lock([robot.find("b", whose=robot.other)], lease_s=60).acquire()
    lock, outcome = robot.me.lock(WHOLE, wait_s=30, lease_s=60), list[BaseException]()

    def acquire() -> None:
        try:
            lock.acquire()
        except errors.LockLost as error:
            outcome.append(error)

    waiting = threading.Thread(target=acquire)
    waiting.start()
    wait_until(lambda: any(info.waiting for info in robot.other.locks()))  # it has a, and waits for b
    robot.other.break_lock([robot.find("a", whose=robot.other)], "to see")
    lock.lose("its part of a was taken back")
    taken.release()
    waiting.join(30)
    assert outcome
    assert not lock.held
    wait_until(lambda: robot.other.locks() == [])


def test_S14_a_device_that_could_not_be_stopped_cannot_be_locked_until_resume(robot: Robot) -> None:
    robot["a"].stop_fails = True
    lock = robot.me.lock(WHOLE, lease_s=4).acquire()
    with lock.use():
        robot.find("a", "go_on")(0.1)
    assert len(robot.other.break_lock(WHOLE, "maintenance")) == 2
    with pytest.raises(errors.NotStopped, match=r"could not be stopped at .* so no client can lock it"):
        robot.other.lock(WHOLE, wait_s=20).acquire()
    [info] = robot.other.locks()
    assert (info.resources, info.holder.owner) == (("a",), "nobody")  # plain: nobody
    robot["a"].resource.moving = False
    assert robot.other.resume(WHOLE) == ["a"]
    with robot.other.lock(WHOLE, wait_s=20):
        pass
    wait_until(lambda: not lock.held)


def test_S08_a_stop_by_another_latches_until_the_owner_of_the_lock_resumes(robot: Robot) -> None:
    with robot.me.lock(WHOLE):
        robot.find("a")(0.1)
        robot.find("a", "stop", robot.other)()
        with pytest.raises(errors.Stopped):
            robot.find("a")(0.2)
        [stop] = robot.other.call(where(name="stops", container=robot.find("a").container))
        assert (stop.resource, stop.by, stop.estop) == ("a", "tester", False)
        with pytest.raises(errors.LockedByOther):
            robot.other.resume(WHOLE)
        assert robot.me.resume(WHOLE) == ["a"]
        assert robot.other.call(where(name="stops", container=robot.find("a").container)) == []
        assert robot.find("a")(0.3) == 0.3


def test_resuming_waits_for_what_it_names_and_says_what_looks_like_it(robot: Robot) -> None:
    late = Joint("late")
    late.resource.latch = Latch("another", "stopped")
    timer = threading.Timer(0.1, lambda: robot.system.container("late").register(late, "hall.late"))
    timer.start()
    assert robot.me.resume(where(group="hall"), wait_s=20) == ["late"]
    with pytest.raises(errors.NoSuchService, match=r"hall\.late") as refused:
        robot.me.resume(where(group="hall.lat"), wait_s=0)
    assert refused.value.near == ("hall.late",)
    with pytest.raises(errors.ConfigurationError, match="nothing that matches actuates, so there is nothing to resume"):
        robot.me.resume(where(group="robot", name="where_is_it"), wait_s=0)


def test_a_call_under_a_lock_that_is_taken_away_writes_nothing_any_more(robot: Robot) -> None:
    robot["a"].hold.clear()
    handle = robot.find("a")
    lock = robot.me.lock([handle], lease_s=60).acquire()
    with lock.use():
        run = handle.start(0.1)
    assert robot["a"].entered.wait(20)
    robot.other.break_lock([handle], "to see")
    robot["a"].hold.set()
    assert run.exception(20) is not None
    assert robot["a"].written == []


def test_each_refusal_is_an_error_of_its_own(robot: Robot) -> None:
    """One that is raised again keeps every frame that it went through, and what is in them."""
    handle, refusals = robot.find("a"), list[errors.LockLost]()
    with pytest.raises(errors.LockLost), robot.me.lock([handle], lease_s=60):
        robot.other.break_lock([robot.find("a", whose=robot.other)], "to see")
        for _ in range(5):
            with pytest.raises(errors.LockLost) as refused:
                handle(0.1)
            refusals.append(refused.value)
    assert len(set(map(id, refusals))) == 5
    assert len({len(traceback.extract_tb(one.__traceback__)) for one in refusals[1:]}) == 1


def test_a_refused_call_marks_the_lock_as_lost_immediately(robot: Robot) -> None:
    losses, handle = Losses(), robot.find("a")
    lock = robot.me.lock(WHOLE, lease_s=60, on_lost=losses).acquire()
    robot.other.break_lock([robot.find("a", whose=robot.other)], "to see")
    with lock.use(), pytest.raises(errors.LockLost, match="to see"):
        handle(0.1)
    assert not lock.held  # which a renewal would tell in 15 s
    with pytest.raises(errors.LockLost, match="to see"):
        lock.check()
    wait_until(lambda: losses.reported)
    wait_until(lambda: robot.other.locks() == [])


def test_a_lock_of_ones_own_container_learns_of_a_refusal_at_once(robot: Robot) -> None:
    robot.me.register(Joint("own"), "robot.own")
    handle = robot.find("own")
    lock = robot.me.lock([handle], lease_s=60).acquire()
    robot.other.break_lock([robot.find("own", whose=robot.other)], "to see")
    with lock.use(), pytest.raises(errors.LockLost, match="to see"):
        handle(0.1)
    assert not lock.held


def test_giving_back_what_was_taken_away_meanwhile_says_so(robot: Robot) -> None:
    with (
        pytest.raises(errors.LockLost, match="not held any more when it was given back"),
        robot.me.lock(WHOLE, lease_s=60),
    ):
        robot.other.break_lock([robot.find("a", whose=robot.other)], "to see")
    assert robot.other.locks() == []
