"""The lock table by itself, on a clock of the test's."""

import concurrent.futures
import math
import threading
import time
from collections.abc import Iterator

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.lamp_provider import Lamp, found
from tests.unit.trade.lock_table_rig import EPOCH, Table
from trade._resources.grants import Granted, LockRequest
from trade._resources.lock_table import _STOPPING, LockTable
from trade._resources.resource import Holder, Permit, Resource
from trade._threads.scheduler import MOST_THREADS, Callback, ScheduledTask, Scheduler
from trade.errors import LockedByOther, LockLost, MotionStopped, NotStopped, ServiceGone, Stopped
from trade.protocol.messages import Token
from trade.testing import memory_system


@pytest.fixture
def table() -> Iterator[Table]:
    made = Table()
    yield made
    made.close()


def test_waiting_clients_are_served_in_order_of_arrival(table: Table) -> None:
    token = table.take("ab")
    waiting = [table.ask(names, f"s{index}") for index, names in enumerate(["a", "ab", "b", "a"])]
    table.table.release(token.number, "tester")
    first = waiting[0].result(60).token
    assert [asking.done() for asking in waiting[1:]] == [False] * 3  # b is free, but the second one comes before it
    assert first is not None
    table.table.release(first.number, "tester")
    second = waiting[1].result(60).token
    assert second is not None
    table.table.release(second.number, "tester")
    concurrent.futures.wait(waiting, 60)
    assert all(asking.done() for asking in waiting)


def test_a_higher_priority_comes_first_and_takes_nothing_away(table: Table) -> None:
    token = table.take("a")
    low, high = table.ask("a", "low"), table.ask("a", "high", priority=1)
    assert table.resources["a"].live == token.number
    table.table.release(token.number, "tester")
    assert high.result(60).token is not None
    assert not low.done()


def test_what_is_coupled_is_locked_together(table: Table) -> None:
    assert table.acquire("c").resources == ("c", "d")
    with pytest.raises(LockedByOther):
        table.acquire("d", "other")


def test_nothing_is_held_or_pending_after_a_refusal(table: Table) -> None:
    table.take("b")
    with pytest.raises(LockedByOther):
        table.acquire("ab", "other")
    table.call("a").gate()


def test_re_entry_asks_only_for_what_is_not_held_under_the_calls_own_tokens(table: Table) -> None:
    token = table.take("a")
    assert table.acquire("a", tokens=(token,)) == Granted(None, ())
    assert table.acquire("ab", tokens=(token,)).resources == ("b",)


def test_turn_and_emptying_together_last_no_longer_than_was_asked(table: Table) -> None:
    token = table.take("a")
    table.call("a", [token])
    asking = table.ask("a", "other", wait_s=10.0)
    wait_until(lambda: any(info.waiting for info in table.table.infos()))
    table.now = 6.0
    table.table.release(token.number, "tester")
    wait_until(lambda: table.resources["a"].pending not in (None, _STOPPING))  # it is the other one's turn
    assert not asking.done()
    table.advance(5.0)
    with pytest.raises(LockedByOther, match="a call or a motion that has not ended"):
        asking.result(60)


def test_since_is_the_time_of_the_grant_not_of_the_request(table: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: 1000.0)
    token = table.take("a")
    asking = table.ask("a", "other")
    monkeypatch.setattr("time.time", lambda: 2000.0)
    table.table.release(token.number, "tester")
    asking.result(60)
    assert [info.holder.since for info in table.table.infos()] == [2000.0]


@pytest.mark.parametrize("use", ["renew", "call", "gate"])
def test_S12_what_outlived_its_lease_is_over_even_before_any_check(table: Table, use: str) -> None:
    """A provider that was frozen wakes: the first access must not find a lock that holds."""
    token = table.take("a", lease_s=2.0)
    permitted = table.call("a", [token])
    table.now = 2.0
    if use == "renew":
        assert table.table.renew([token.number], "tester") == []
    else:
        with pytest.raises(LockLost):
            permitted.gate() if use == "gate" else table.call("a", [token], call_id=1)


def test_S12_a_renewed_lease_restarts_and_a_lost_one_never_does(table: Table) -> None:
    token = table.take("a", lease_s=2.0)
    table.advance(1.5)
    assert table.table.renew([token.number], "tester") == [token.number]
    table.advance(1.5)
    assert table.table.renew([token.number], "tester") == [token.number]
    table.advance(2.0)
    assert table.table.renew([token.number], "tester") == []
    assert table.table.infos() == []


@pytest.fixture
def real() -> Iterator[LockTable]:
    """A lock table whose leases end on the clock of this computer."""
    timers = Scheduler("trade-timers")
    table = LockTable(EPOCH, "home", timers)
    yield table
    table.close()
    timers.close()


def test_S12_a_lease_ends_in_its_time_although_other_timers_block() -> None:
    timers, may_end = Scheduler("trade-timers"), threading.Event()

    def wait() -> None:
        assert may_end.wait(60)

    table = LockTable(EPOCH, "home", timers)
    table.adopt("a")
    for _ in range(10):
        timers.begin(wait, 0)
    table.acquire(["a"], Holder("tester", "one", "one", "", 0.0), LockRequest(lease_s=0.1))
    wait_until(lambda: table.infos() == [])
    assert not may_end.is_set()
    may_end.set()
    table.close()
    timers.close()


def test_S12_a_container_has_a_fixed_number_of_timers_so_that_none_waits_for_another_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each that blocks has a thread of its own: there are fewer of them than a scheduler may have threads."""
    timers, due = list[Callback](), Scheduler.due

    def count(scheduler: Scheduler, act: Callback) -> ScheduledTask:
        if scheduler._name == "trade-timers":
            timers.append(act)
        return due(scheduler, act)

    monkeypatch.setattr(Scheduler, "due", count)
    with memory_system() as system:
        here, there = system.container("here"), system.container("there")
        begun = len(timers)
        for group in ("one", "two", "three"):
            there.register(Lamp(), group)
            dim = found(here, group)
            with here.lock([dim]):
                dim.start(0.5).result(60)
    assert len(timers) == begun
    assert begun < MOST_THREADS


def test_a_lease_ends_without_a_question(real: LockTable) -> None:
    real.adopt("a")
    real.acquire(["a"], Holder("tester", "one", "one", "", 0.0), LockRequest(lease_s=0.1))
    wait_until(lambda: real.infos() == [])


def test_a_short_lease_ends_in_its_time_although_the_thread_sleeps_until_a_longer_one_ends(real: LockTable) -> None:
    for name in "ab":
        real.adopt(name)
    holder = Holder("tester", "one", "one", "", 0.0)
    real.acquire(["a"], holder, LockRequest(lease_s=3600))
    wait_until(lambda: real._leases.next_ns < math.inf)
    real.acquire(["b"], holder, LockRequest(lease_s=0.1))
    wait_until(lambda: [info.resources for info in real.infos()] == [("a",)])


def test_leases_continue_to_end_after_a_stop_that_raised(table: Table) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    table.table.stop_with(fail)
    table.take("a", lease_s=2.0)
    table.take("b", lease_s=2.0)
    for name in "ab":
        table.resources[name].moving = True
    table.advance(2.0)
    assert table.table.infos() == []
    with pytest.raises(NotStopped):
        table.acquire("a")


def test_only_its_owner_renews_and_releases(table: Table) -> None:
    token = table.take("a")
    assert table.table.renew([token.number], "stranger") == []
    assert not table.table.release(token.number, "stranger")
    assert table.table.release(token.number, "tester")


def test_S14_what_moves_under_a_lost_lock_stops_before_it_is_given_on(table: Table) -> None:
    token = table.take("ab")
    table.resources["a"].moving = True
    asking = table.ask("a", "other")
    table.table.lose(token.number, "gone")
    [(resource, done)] = table.stopping
    assert (resource.name, asking.done()) == ("a", False)
    with pytest.raises(LockedByOther, match="stopping what moved"):
        table.call("a")
    table.call("b").close()
    table.resources["a"].moving = False
    done(resource, "")
    assert asking.result(60).resources == ("a",)


def test_S14_a_client_waiting_for_an_unstoppable_device_is_refused_at_once_until_resumed(table: Table) -> None:
    token = table.take("ab")
    table.resources["a"].moving = True
    waiting = [table.ask(names, names) for names in ("a", "ab")]
    table.table.lose(token.number, "gone")
    [(resource, done)] = table.stopping
    done(resource, "no answer")
    for asking in waiting:
        with pytest.raises(NotStopped):
            asking.result(60)
    resource.moving = False
    with pytest.raises(NotStopped):
        table.acquire("ab")
    resource.resume()
    table.acquire("ab")


def test_S14_a_client_that_waits_for_rest_does_not_get_what_could_not_be_stopped(table: Table) -> None:
    resource = table.resources["a"]
    resource.moving = True  # for a client without a lock, which is gone then
    asking = table.ask("a", "other")
    wait_until(lambda: resource.pending is not None, "it is being emptied")
    resource.stop_ended("no answer")
    resource.moving = False
    with pytest.raises(NotStopped):
        asking.result(60)
    assert table.table.infos() == []


def _could_not_be_stopped(table: Table, names: str) -> Resource:
    """The first of these: their lock was lost while it moved, and its driver did not hear the stop; it rests by now."""
    token, resource = table.take(names), table.resources[names[0]]
    resource.moving = True
    table.table.lose(token.number, "gone")
    [(_, done)] = table.stopping
    done(resource, "no answer")
    resource.moving = False
    return resource


def test_S14_a_later_stop_that_succeeds_frees_nothing(table: Table) -> None:
    resource = _could_not_be_stopped(table, "a")
    resource.stop_ended("")
    with pytest.raises(NotStopped):
        table.acquire("a")
    resource.resume()
    table.acquire("a")


def test_S14_a_refusal_says_what_could_not_be_stopped_when_why_and_what_to_do_and_it_is_listed(table: Table) -> None:
    resource = _could_not_be_stopped(table, "ab")
    with pytest.raises(
        NotStopped, match=r"a on .* could not be stopped at \d\d:\d\d:\d\d \(no answer\), so no client can"
    ):
        table.acquire("a")
    with pytest.raises(NotStopped, match="Check it, then run `trade resume a`"):
        table.acquire("a")
    [info] = table.table.withheld()
    assert (info.resources, info.holder.owner) == (("a",), "nobody")  # plain: nobody
    assert "no answer" in info.holder.purpose
    table.call("a").close()  # calls without a lock are not refused
    resource.resume()
    assert table.table.withheld() == []


def test_S08_a_call_of_stopped_resources_names_all_that_its_caller_would_have_to_resume(table: Table) -> None:
    table.call("abc").close()
    for name in "ac":
        table.resources[name].stop("anna/desk", ["else"])
    with pytest.raises(Stopped, match=r"call .*`trade resume a c`") as refused:
        table.call("abc")
    assert (refused.value.resource, refused.value.others) == ("a", ("c",))
    table.resources["a"].resume()
    with pytest.raises(Stopped, match=r"call .*`trade resume c`"):
        table.call("abc")
    table.resources["c"].resume()
    table.call("abc").close()
    assert not table.resources["b"].calls


def test_a_lock_of_what_is_no_longer_offered_is_lost_and_who_waits_for_it_is_refused(table: Table) -> None:
    token = table.take("ab")
    asking = table.ask("a", "other")
    table.table.drop(table.resources["a"])
    with pytest.raises(ServiceGone, match="a is no longer offered"):
        asking.result(60)
    assert table.table.renew([token.number], "tester") == []
    table.acquire("b")
    with pytest.raises(ServiceGone):
        table.acquire("a")


def test_a_session_that_ends_while_it_waits_for_a_call_to_end_gets_nothing(table: Table) -> None:
    running = table.call("a")
    asking = table.ask("a", "dead/x")
    table.table.session_ended("dead", "killed")
    running.close()
    with pytest.raises((LockedByOther, ServiceGone)):
        asking.result(60)
    assert table.table.infos() == []


def test_the_former_owner_learns_why_even_during_the_stop_or_under_another_owner(table: Table) -> None:
    token = table.take("a")
    table.resources["a"].moving = True
    table.table.lose(token.number, "broken by an operator: my turn")
    [(resource, done)] = table.stopping
    with pytest.raises(LockLost, match="my turn"):
        table.call("a", [token])
    resource.moving = False
    done(resource, "")
    table.take("a", "other")
    with pytest.raises(LockLost, match="my turn"):
        table.call("a", [token])
    with pytest.raises(LockedByOther):
        table.call("a")


def test_why_grants_ended_is_known_of_the_last_few_and_never_of_more(table: Table) -> None:
    numbers: list[int] = []
    for _ in range(300):
        numbers.append(table.take("a").number)
        table.table.release(numbers[-1], "tester")
    assert table.table.why_ended(numbers[-1]) == "it was given back"
    assert table.table.why_ended(numbers[0]) == "it ended long ago"


def test_S13_no_call_is_admitted_and_all_are_waited_for_but_the_asking_chain(table: Table) -> None:
    own, other = table.call("a", call_id=1), table.call("a", call_id=2)
    asking = table.ask("a", "asking", calls=[1])
    with pytest.raises(LockedByOther):
        table.call("a", call_id=3)
    other.gate()  # what was admitted continues
    assert not asking.done()
    other.close()
    asking.result(60)
    with pytest.raises(LockedByOther):
        own.gate()  # its call continues, but without the lock


def test_S13_a_motion_that_a_call_left_running_is_waited_for(table: Table) -> None:
    table.resources["a"].moving = True
    asking = table.ask("a")
    assert not asking.done()
    table.resources["a"].moving = False
    asking.result(60)


def test_S11_the_number_of_a_grant_must_match_exactly_and_a_greater_one_is_refused(table: Table) -> None:
    old = table.take("a")
    admitted = table.call("a", [old])
    table.table.release(old.number, "tester")
    admitted.close()
    new = table.take("a", "other")
    with pytest.raises(LockLost):
        admitted.gate()
    for number in (old.number, new.number + 1):
        with pytest.raises(LockLost):
            table.call("a", [Token(EPOCH, number)])
    with pytest.raises(LockedByOther):
        table.call("a", [Token("another epoch", new.number)])


def test_S08_a_stop_voids_commands_admitted_before_it_whatever_the_locks(table: Table) -> None:
    token = table.take("a")
    admitted = table.call("a", [token])
    table.resources["a"].stop("owner", ["s"], "its session ended")
    with pytest.raises(MotionStopped, match="its session ended"):
        admitted.gate()
    table.call("a", [token], call_id=1).gate()
    table.resources["a"].stop("stranger", ["else"])
    with pytest.raises(Stopped):
        table.call("a", [token], call_id=2)


def test_S08_a_call_admitted_while_a_foreign_stop_is_under_way_is_void(table: Table) -> None:
    let_in: list[Permit] = []

    def asking() -> Iterator[str]:
        let_in.append(table.call("a", session="mover"))
        yield "stranger"

    table.resources["a"].stop("stranger", asking())
    with pytest.raises(MotionStopped):
        let_in[0].gate()


def test_admitting_and_emptying_at_the_same_moment_never_both_succeed(table: Table) -> None:
    """A call that passes while a lock is granted is either waited for or refused."""
    rounds, both = 300, 0
    ready = threading.Barrier(2)

    def call(number: int) -> bool:
        ready.wait()
        try:
            permitted = table.call("a", call_id=number)
        except LockedByOther:
            return False
        return bool(permitted)

    for number in range(1, rounds):
        calling = table.pool.submit(call, number)
        ready.wait()
        try:
            granted = table.acquire("a")
        except LockedByOther:
            granted = None
        both += calling.result(60) and granted is not None
        table.resources["a"].calls.clear()
        if granted is not None and granted.token is not None:
            table.table.release(granted.token.number, "tester")
    assert both == 0


@pytest.mark.virtual_time
def test_a_client_behind_one_that_gives_up_is_woken() -> None:
    began = time.monotonic()
    table = Table(lambda: time.monotonic() - began)
    try:
        table.take("a", lease_s=60)
        first = table.ask("ab", "one", wait_s=0.5)
        second = table.ask("b", "two", wait_s=30.0)
        with pytest.raises(LockedByOther):
            first.result(20)
        assert second.result(20).token is not None
        assert time.monotonic() - began < 1
    finally:
        table.close()
