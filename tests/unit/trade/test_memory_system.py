"""A whole system in one process: it converges whatever the network does, and a death lets no other hang."""

import concurrent.futures
import contextlib
import random
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.lamp_provider import Lamp, Pair, found, labels
from trade import Container, errors, where
from trade._discovery.announcer import Announcer
from trade.errors import ContainerLost, ServiceGone
from trade.protocol.keys import Address
from trade.protocol.messages import ProviderInfo, ServiceInfo
from trade.testing import MemorySystem, MessageKind, memory_system
from trade.transport.memory import InFlightMessage, MemoryTransport

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]


def test_containers_find_and_call_each_other() -> None:
    with memory_system() as system:
        system.container("b").register(Lamp(), "robot")
        assert found(system.container("a"))(0.5) == 0.5


def test_a_name_belongs_to_one_running_container() -> None:
    with memory_system() as system:
        first = system.container("a")
        assert system.container("a") is first
        system.kill("a")
        second = system.container("a")
        assert second is not first
        second.close()
        assert system.container("a") is not second


@pytest.mark.parametrize("lost", ["call/", "reply/"])
@pytest.mark.parametrize("begun", ["away", "on the way back", "first", "first, waited for"])
def test_a_container_appears_before_its_routes_do_and_a_call_runs_once(lost: str, begun: str) -> None:
    """Beyond a bridge that opens again, the sign of life comes first. A call waited for its deadline then."""
    with memory_system() as system, concurrent.futures.ThreadPoolExecutor() as pool:
        lamp, first = Lamp(), begun.startswith("first")
        system.container("b").register(lamp, "robot")
        caller, dim = system.container("a"), found(system.container("a"))
        if not first:
            dim(0.5)
        back = partial(caller._parts.caller.lost, dim.key.address, back=True)
        heal = system.lose(lambda message: message.key.startswith(lost))
        if begun == "on the way back":
            back()
        run = pool.submit(dim, 0.7) if begun == "first, waited for" else dim.start(0.7)
        if begun == "away":
            back()
        if first:
            wait_until(lambda: caller._parts.caller._clocks_due)
        elif lost == "reply/":
            wait_until(lambda: lamp.values == [0.5, 0.7])
        system.advance(1.0)
        assert not run.done()
        heal()
        system.advance(2.0)
        assert run.result(5) == 0.7
        assert lamp.values == ([0.7] if first else [0.5, 0.7])


def test_a_container_that_is_back_and_never_answers_is_asked_a_few_times_only() -> None:
    with memory_system() as system:
        system.container("b").register(Lamp(), "robot")
        caller, dim = system.container("a"), found(system.container("a"))
        dim(0.5)
        asked = list[str]()
        system.lose(lambda message: message.key.startswith("call/") and asked.append(message.key) is None)
        caller._parts.caller.lost(dim.key.address, back=True)
        system.advance(60.0)
        assert len(asked) == 4


def test_a_container_without_callers_is_not_asked_when_it_is_back() -> None:
    with memory_system() as system:
        system.container("b").register(Lamp(), "robot")
        caller, dim = system.container("a"), found(system.container("a"))
        system.settle()
        before = system.sent()
        caller._parts.caller.lost(dim.key.address, back=True)
        system.settle()
        assert system.sent() == before


def test_at_the_end_every_container_is_closed() -> None:
    with memory_system() as system:
        containers = [system.container(name) for name in "ab"]
        system.kill("b")
    assert not any(container.healthy() for container in containers)


def test_two_systems_know_nothing_of_each_other() -> None:
    with memory_system() as one, memory_system() as other:
        one.container("a").register(Lamp(), "robot")
        assert labels(other.container("b")) == []


def test_over_slow_links_blocking_calls_return_while_time_flows() -> None:
    with memory_system(seed=3) as system:
        a, b = system.container("a"), system.container("b")
        system.delay(0.05, jitter_s=0.05)
        b.register(Lamp(), "robot")
        system.settle()
        with system.flowing():
            assert found(a)(0.5) == 0.5
        assert system.clock.monotonic_ns() >= 5 * 50_000_000  # the entry, the clock and back, the call and back


def test_over_slow_links_started_calls_can_be_driven_to_their_end() -> None:
    with memory_system() as system:
        a, b = system.container("a"), system.container("b")
        b.register(Lamp(), "robot")
        handle = found(a)
        system.delay(3600, between=(a, b))
        run = handle.start(0.5)
        system.drive(run.done)
        assert run.result() == 0.5
        assert system.clock.monotonic_ns() == 4 * 3600 * 10**9


@pytest.mark.real_clock
def test_the_page_on_testing_does_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).parents[3]
    page = root / "docs" / "testing.md"
    monkeypatch.chdir(root / "examples")
    module = ModuleType("page_on_testing")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    known = vars(module)
    known.update(pytest=pytest, errors=errors)
    for program in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        exec(program, known)
    tests = [value for name, value in known.items() if name.startswith("test_")]
    assert len(tests) == 11
    for test in tests:
        test()


def test_a_call_takes_two_messages_after_the_first() -> None:
    with memory_system() as system:
        a, b = system.container("a"), system.container("b")
        system.container("c")
        b.register(Lamp(), "robot")
        handle = found(a)
        system.settle()
        before = system.sent()
        handle(0.1)
        assert system.sent() - before == 4  # it asks for the clock first
        before = system.network.sent.copy()
        for _ in range(10):
            handle(0.1)
        assert system.network.sent - before == Counter({MessageKind.PUT: 20})


def test_joining_takes_as_many_messages_as_there_are_containers_and_providers() -> None:
    with memory_system() as system:
        for size in range(5):
            system.settle()
            before = system.sent()
            container = system.container(f"c{size}")
            system.settle()
            hosts, providers = size, size * 2  # others, and what they offer beyond the middleware's own
            each = 2 + 4 + 4  # two signs of life; each asks the other for its own services, e-stops and tally
            assert system.sent() - before == hosts * each + providers
            for group in ("one", "two"):
                container.register(Lamp(), group)


def test_registering_takes_one_message_for_each_other_container() -> None:
    with memory_system() as system:
        a, *_ = [system.container(name) for name in "abcd"]
        system.settle()
        lamp, before = Lamp(), system.network.sent.copy()
        a.register(lamp, "robot")
        a.deregister(lamp)
        assert system.network.sent - before == Counter({MessageKind.ANNOUNCE: 6})


def test_a_joining_container_is_informed_by_answers_only(lamp: Lamp) -> None:
    with memory_system() as system:
        a = system.container("a")
        before = system.sent(MessageKind.ANNOUNCE)
        b = system.container("b")
        system.settle()
        assert len(b.services(where(group="trade"))) == 2 * len(a.services(where(group="trade", container="a")))
        assert system.sent(MessageKind.ANNOUNCE) == before
        b.register(lamp, "robot")
        assert system.sent(MessageKind.ANNOUNCE) == before + 1


@pytest.mark.parametrize(
    ("known", "beats"),
    [
        (2, [1, 2, 4, 8, 16, 24, 32]),
        (35, [1, 2, 4, 8, 16, 24, 32]),
        (40, [1, 2, 4, 8, 10, 20, 30]),
        (1000, [1, 2, 4, 8, 16, 32]),
    ],
)
def test_an_unchanged_container_reports_its_revision_ever_less_often_and_seldom_among_many(
    lamp: Lamp, known: int, beats: list[int]
) -> None:
    with memory_system() as system:
        system.container("a")
        b = system.container("b")
        announcer = b._parts.announcer

        def beats_that_tell(count: int) -> list[int]:
            return [beat for beat in range(1, count + 1) if _sends_one(system, partial(announcer.beat, known))]

        b.register(lamp, "robot")
        assert beats_that_tell(33) == beats
        b.deregister(lamp)
        assert beats_that_tell(3) == [1, 2]


def _sends_one(system: MemorySystem, action: Callable[[], None]) -> bool:
    before = system.sent()
    action()
    return system.sent() > before


def test_after_a_partition_each_side_knows_only_itself_and_then_everything_again(
    pair: Pair,
) -> None:
    with memory_system() as system:
        caller, callee, handle = pair(system)
        caller.register(Lamp(), "hall")
        system.partition(caller, callee)
        system.advance(2)
        assert (labels(caller), labels(callee)) == (["caller/hall.dim"], ["callee/robot.dim"])
        with pytest.raises(ServiceGone, match="container callee has ended, restarted or cannot be reached"):
            handle(0.1)
        system.heal()
        system.settle()
        assert labels(caller) == labels(callee) == ["caller/hall.dim", "callee/robot.dim"]
        assert handle(0.2) == 0.2


def test_a_partition_within_the_lease_changes_nothing_but_the_time(pair: Pair) -> None:
    with memory_system() as system:
        caller, callee, handle = pair(system)
        system.partition(caller, callee)
        run = handle.start(0.1)
        system.advance(1.9)
        assert not run.done()
        system.heal(caller, callee)
        assert run.result(20) == 0.1
        system.advance(5)
        assert labels(caller) == ["callee/robot.dim"]


def test_what_comes_and_goes_during_a_partition_is_known_after_it(
    pair: Pair, lamp: Lamp, eventually: Eventually
) -> None:
    with memory_system() as system:
        caller, callee, _ = pair(system)
        kept = Lamp()
        callee.register(kept, "kept")
        system.partition(caller, callee)
        system.advance(2)
        callee.deregister(lamp)
        callee.register(Lamp(), "new")
        assert labels(caller) == []
        joined: list[str] = []
        caller.joined(where(name="dim"), lambda handle: joined.append(handle.label))
        system.heal()
        system.settle()
        assert labels(caller) == ["callee/kept.dim", "callee/new.dim"]
        assert eventually(lambda: sorted(joined) == ["kept.dim", "new.dim"])


@pytest.mark.parametrize("deaf", ["caller", "callee"])
def test_a_call_over_a_link_that_lets_one_way_pass_ends_with_the_lease(
    pair: Pair, lamp: Lamp, deaf: str, eventually: Eventually
) -> None:
    with memory_system() as system:
        caller, callee, handle = pair(system)
        speaker = callee if deaf == "caller" else caller
        system.partition(speaker, deaf, one_way=True)
        run = handle.start(0.1)
        if deaf == "caller":
            assert eventually(lambda: lamp.values == [0.0, 0.1])  # it was done; no caller will know
        system.advance(2)
        assert isinstance(run.exception(20), ContainerLost)
        assert labels(caller) == []
        assert [info.name for info in callee.containers()] == ["callee"]
        system.heal()
        system.settle()
        assert labels(caller) == labels(callee) == ["callee/robot.dim"]
        assert handle(0.2) == 0.2
        assert lamp.values == ([0.0, 0.1, 0.2] if deaf == "caller" else [0.0, 0.2])


def test_a_partition_of_two_leaves_calls_of_a_third_alone(pair: Pair) -> None:
    with memory_system() as system:
        caller, callee, _ = pair(system)
        third = system.container("third")
        system.partition(caller, callee)
        system.advance(2)
        assert found(third)(0.3) == 0.3


def losing(*payloads_of: str) -> Callable[[InFlightMessage], bool]:
    """What is announced of providers whose names begin so gets lost."""
    return lambda passage: (
        passage.kind is MessageKind.ANNOUNCE and passage.key.rpartition("/")[2].startswith(payloads_of)
    )


def test_a_lost_announcement_is_known_with_the_next_one() -> None:
    with memory_system() as system:
        a, b = system.container("a"), system.container("b")
        system.settle()
        end = system.lose(losing("Lamp"))
        b.register(Lamp(), "lost")
        end()
        system.settle()
        assert labels(a) == []
        b.register(Lamp(), "heard")
        system.settle()
        assert labels(a) == ["b/heard.dim", "b/lost.dim"]


def test_a_lost_withdrawal_is_known_with_the_next_announcement(lamp: Lamp) -> None:
    with memory_system() as system:
        a, b = system.container("a"), system.container("b")
        b.register(lamp, "lost")
        system.settle()
        end = system.lose(losing("Lamp"))
        b.deregister(lamp)
        end()
        assert labels(a) == ["b/lost.dim"]
        b.register(Lamp(), "heard")
        system.settle()
        assert labels(a) == ["b/heard.dim"]


def test_after_a_lost_announcement_the_next_sign_of_life_reveals_it(lamp: Lamp, eventually: Eventually) -> None:
    with memory_system(beat_s=0.05) as system:
        a, b = system.container("a"), system.container("b")
        end = system.lose(losing("Lamp"))
        b.register(lamp, "lost")
        assert eventually(lambda: labels(a) == ["b/lost.dim"])
        b.deregister(lamp)
        assert eventually(lambda: labels(a) == [])
        end()


def test_what_is_lost_with_a_whole_storm_is_one_question() -> None:
    with memory_system() as system:
        a, b = system.container("a"), system.container("b")
        random_ = random.Random(1)
        end = system.lose(lambda passage: passage.kind is MessageKind.ANNOUNCE and random_.random() < 0.5)
        system.settle()
        before = system.sent(MessageKind.ASK)
        with held(a):
            for number in range(200):
                b.register(Lamp(), f"robot-{number}")
        end()
        b.register(Lamp(), "last")
        system.settle()
        assert len(labels(a)) == 201
        assert system.sent(MessageKind.ASK) - before <= 3


@contextlib.contextmanager
def held(container: Container) -> Iterator[None]:
    """While this lasts a container sends no query: whatever it misses comes together."""
    asker, unlocked = container._parts.watch._asker, threading.Event()
    asker._beat, asker._next_beat = lambda: unlocked.wait(20), 0.0
    asker._remind()
    try:
        yield
    finally:
        unlocked.set()


def test_a_container_that_says_nothing_of_itself_is_asked_again_less_and_less_often(
    monkeypatch: pytest.MonkeyPatch, eventually: Eventually
) -> None:
    monkeypatch.setattr("trade._discovery.resync._FIRST_PAUSE_S", 0.001)
    with memory_system() as system:
        a = system.container("a")
        ghost = MemoryTransport(system.network, "ghost")
        questions = ghost.questions("registry/*/it/ghost/e1/*")
        ghost.appear("alive/it/ghost/e1")
        pauses = list[float]()
        known, silent = a._parts.watch._asker._pauses, Address("it", "ghost", "e1")
        for _ in range(5):
            questions.receive().close()
            assert eventually(lambda: known.get(silent, 0) not in [0, *pauses])
            pauses.append(known[silent])
        assert pauses == [0.001 * 2**turn for turn in range(5)]
        system.container("b").register(Lamp(), "robot")
        assert found(a)(0.5) == 0.5
        ghost.close()


def test_a_container_that_asks_in_vain_still_receives_signs_of_life(lamp: Lamp, eventually: Eventually) -> None:
    with memory_system() as system:
        a = system.container("a")
        ghost = MemoryTransport(system.network, "ghost")
        questions = ghost.questions("registry/*/it/ghost/e1/*")
        ghost.appear("alive/it/ghost/e1")
        question = questions.receive()  # and no answer
        b = system.container("b")
        assert eventually(lambda: {info.name for info in a.containers()} == {"a", "b", "ghost"})
        b.register(lamp, "robot")
        assert found(a)(0.5) == 0.5
        b.close()
        assert eventually(lambda: {info.name for info in a.containers()} == {"a", "ghost"})
        question.close()
        ghost.close()


def test_no_container_waits_behind_one_that_failed_to_answer(
    monkeypatch: pytest.MonkeyPatch, eventually: Eventually
) -> None:
    monkeypatch.setattr("trade._discovery.resync._ANSWER_S", 0.02)
    monkeypatch.setattr("trade._discovery.resync._SLOW_ANSWER_S", 3600.0)
    with memory_system() as system:
        a, silent, other = (
            system.container("a"),
            *(MemoryTransport(system.network, name) for name in ("silent", "other")),
        )
        questions = silent.questions("registry/*/it/silent/e1/*")
        silent.appear("alive/it/silent/e1")
        questions.receive()
        question = questions.receive()  # from now on it is waited for as long as it takes
        address = Address("it", "other", "e1")
        announcer = Announcer(other, address)
        info = ServiceInfo(name="dim", signature="dim()")
        entry = ProviderInfo(revision=1, groups=("hall",), kind="Lamp", host="h", pid=1, services=(info,))
        announcer.announce("hall", "lamp", entry)
        announcer.appear()
        assert eventually(lambda: labels(a) == ["other/hall.dim"])
        announcer.close()
        question.close()
        silent.close()


def test_more_containers_than_ever_end_and_one_of_them_returns_with_all_its_services(eventually: Eventually) -> None:
    with memory_system() as system:
        a, b = system.container("a"), system.container("b")
        b.register(Lamp(), "robot")
        system.partition(a, b)
        system.advance(2)
        for number in range(300):
            ghost = MemoryTransport(system.network, f"ghost-{number}")
            ghost.appear(f"alive/it/ghost/e{number}")
            ghost.close()
        assert eventually(lambda: not a._parts.watch.busy)
        system.heal()
        system.settle()
        assert labels(a) == ["b/robot.dim"]
        assert len(a._parts.registry._containers) == len(a._parts.caller._peers) + 1 == 2
