"""The transport in memory keeps the guarantees of every transport; its time, delays and faults do what they say."""

import concurrent.futures
import contextlib
from collections.abc import Callable, Iterator

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from trade.testing import LossConformance, Severable, TransportConformance
from trade.transport.base import Channel, ChannelClosed, Message
from trade.transport.memory import Clock, InFlightMessage, MemoryTransport, MessageKind, Network
from trade.transport.memory.keys import meet


class TestMemory(TransportConformance):
    @contextlib.contextmanager
    def network(self) -> Iterator[Callable[[], MemoryTransport]]:
        network = Network()
        with contextlib.ExitStack() as stack:

            def open_transport() -> MemoryTransport:
                transport = MemoryTransport(network)
                stack.callback(transport.close)
                return transport

            yield open_transport


class TestMemoryLosses(LossConformance):
    @contextlib.contextmanager
    def severable(self) -> Iterator[Severable]:
        network = Network()
        one, other = MemoryTransport(network), MemoryTransport(network)

        def sever() -> None:
            network.partition(one.node, other.node)
            network.clock.advance(2)

        with contextlib.closing(one), contextlib.closing(other):
            yield Severable(one, other, sever, network.heal)


_chunk = st.sampled_from(["a", "b", "ab", "*", "**", "@v", "@w"])


@given(st.lists(_chunk, min_size=1, max_size=5), st.lists(_chunk, min_size=1, max_size=5))
def test_patterns_mean_what_they_mean_to_zenoh(one: list[str], other: list[str]) -> None:
    first, second = (zenoh.KeyExpr.autocanonize("/".join(chunks)) for chunks in (one, other))
    assert meet(str(first), str(second)) == first.intersects(second)


def test_time_does_not_pass_until_it_is_moved() -> None:
    clock = Clock()
    assert clock.monotonic_ns() == 0
    clock.advance(1.5)
    assert clock.monotonic_ns() == 1_500_000_000


def test_what_is_due_happens_in_order_urgent_first_each_at_its_moment() -> None:
    clock, happened = Clock(), list[tuple[str, int]]()
    for name, when_ns, urgent in (("late", 30, False), ("b", 20, False), ("c", 20, False), ("a", 20, True)):
        clock.at(when_ns, lambda name=name: happened.append((name, clock.monotonic_ns())), urgent=urgent)
    clock.advance(25e-9)
    assert happened == [("a", 20), ("b", 20), ("c", 20)]
    assert clock.step()
    assert happened[-1] == ("late", 30)
    assert not clock.step()


def test_what_happens_may_put_off_more_for_the_same_advance() -> None:
    clock, happened = Clock(), list[int]()
    clock.at(10, lambda: clock.at(20, lambda: happened.append(clock.monotonic_ns())))
    clock.advance(1)
    assert happened == [20]


class Room:
    """Two transports; the second one listens to ``room/**``."""

    def __init__(self, seed: int = 0) -> None:
        self.network = Network(seed=seed)
        self.one, self.other = (MemoryTransport(self.network, name) for name in ("one", "other"))
        self.ear = self.other.subscribe("room/**")
        self.signs = self.other.presences("alive/one")
        self.sign = self.one.appear("alive/one")
        assert heard(self.signs) == [b""]

    def say(self, *words: str, key: str = "room/a", urgent: bool = False) -> None:
        publisher = self.one.publish(key, urgent=urgent)
        for word in words:
            publisher.put(word.encode())

    def cut(self, **options: bool) -> None:
        self.network.partition(self.one.node, self.other.node, **options)


def heard(channel: Channel) -> list[bytes | None]:
    """What a channel has now."""
    found: list[bytes | None] = []
    queue = channel._queue  # type: ignore[attr-defined]
    while not queue.empty():
        found.append(queue.get().payload)
    return found


@pytest.fixture
def room() -> Room:
    return Room()


def test_a_delayed_message_arrives_when_its_time_has_come(room: Room) -> None:
    room.network.delay(0.1)
    room.say("slow")
    room.network.clock.advance(0.099)
    assert heard(room.ear) == []
    room.network.clock.advance(0.001)
    assert heard(room.ear) == [b"slow"]


def test_one_link_can_be_slow_alone(room: Room) -> None:
    third = MemoryTransport(room.network)
    ear = third.subscribe("room/**")
    room.network.delay(0.1, between=(room.one.node, room.other.node))
    room.say("word")
    assert heard(ear) == [b"word"]
    assert heard(room.ear) == []


@pytest.mark.parametrize("seed", range(5))
def test_jitter_leaves_the_order_of_one_publisher_alone(seed: int) -> None:
    room = Room(seed)
    room.network.delay(0.001, jitter_s=0.1)
    words = [str(number) for number in range(50)]
    room.say(*words)
    room.network.delay(0)
    room.say("last")
    room.network.traffic.settle()
    assert heard(room.ear) == [word.encode() for word in (*words, "last")]


def test_the_same_seed_gives_the_same_times() -> None:
    def times(seed: int) -> list[int]:
        room = Room(seed)
        room.network.delay(0.01, jitter_s=0.1)
        arrivals: list[int] = []
        room.network.tap(
            lambda passage: arrivals.append(room.network.clock.monotonic_ns()) if passage.arrived else None
        )
        room.say(*"abcdef")
        room.network.traffic.settle()
        return arrivals

    assert times(1) == times(1)
    assert times(1) != times(2)


def test_urgent_messages_overtake_all_others(room: Room) -> None:
    room.network.delay(0.01, jitter_s=0.1)
    room.say(*"abcdefgh")
    room.network.delay(0.01)
    room.say("stop", urgent=True)
    room.network.traffic.settle()
    assert heard(room.ear)[0] == b"stop"


def test_what_is_put_before_the_end_of_a_transport_arrives_before_its_signs_fall(room: Room) -> None:
    room.network.delay(0.01, jitter_s=0.1)
    seen: list[tuple[MessageKind, bool]] = []
    room.network.tap(lambda passage: seen.append((passage.kind, passage.arrived)))
    room.say(*"abc")
    room.one.close()
    room.network.traffic.settle()
    assert heard(room.ear) == [b"a", b"b", b"c"]
    assert heard(room.signs) == [None]
    assert seen[-1] == (MessageKind.LEAVE, True)


def test_a_test_may_drive_the_time_of_other_threads(room: Room) -> None:
    room.network.delay(0.5)
    with room.network.traffic.flowing():
        room.say("word")
        assert room.ear.receive().payload == b"word"
    assert room.network.clock.monotonic_ns() == 500_000_000
    with pytest.raises(TimeoutError, match="does not hold after 0"):
        room.network.traffic.drive(lambda: False, limit_s=0)


def test_a_cut_within_the_lease_only_delays(room: Room) -> None:
    room.cut()
    room.say(*"abc")
    room.network.clock.advance(1.999)
    assert heard(room.ear) == []
    room.network.heal()
    assert heard(room.ear) == [b"a", b"b", b"c"]
    room.network.clock.advance(10)
    assert heard(room.signs) == []


def test_a_second_cut_has_a_lease_of_its_own(room: Room) -> None:
    room.cut()
    room.network.clock.advance(1.5)
    room.network.heal()
    room.cut()
    room.network.clock.advance(1.5)
    assert heard(room.signs) == []
    room.network.clock.advance(0.5)
    assert heard(room.signs) == [None]


def test_a_cut_that_outlasts_the_lease_loses_what_was_said_meanwhile(room: Room) -> None:
    room.cut()
    room.say("lost")
    room.network.clock.advance(2)
    room.say("lost, too")
    room.network.heal()
    room.say("after")
    assert heard(room.ear) == [b"after"]
    assert heard(room.signs) == [None, b""]


def test_a_one_way_cut_stops_one_way_and_ends_the_link_for_both(room: Room) -> None:
    back, signs = room.one.subscribe("back"), room.one.presences("alive/other")
    _sign = room.other.appear("alive/other")
    room.cut(one_way=True)
    room.say("lost")
    room.other.publish("back").put(b"through")
    assert (heard(room.ear), heard(back)) == ([], [b"through"])
    room.network.clock.advance(2)
    assert (heard(room.signs), heard(signs)) == ([None], [b"", None])


def test_a_partition_of_two_leaves_a_third_alone(room: Room) -> None:
    third = MemoryTransport(room.network)
    ear, signs = third.subscribe("room/**"), third.presences("alive/**")
    room.cut()
    room.network.clock.advance(2)
    room.say("word")
    assert heard(ear) == [b"word"]
    assert heard(signs) == [b""]


def tell(transport: MemoryTransport, key: str, payload: bytes) -> None:
    """Answer the question that was asked first."""
    question = transport.node.asked[0].receive()
    question.answer(key, payload)
    question.close()


def test_a_container_that_is_cut_off_answers_until_it_is_lost(room: Room) -> None:
    room.one.questions("shop/*")
    room.cut(one_way=True)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        asked = pool.submit(room.other.ask, ["shop/*"], 20)
        tell(room.one, "shop/bread", b"fresh")
        [answer] = asked.result()
    assert answer.messages == [Message("shop/bread", b"fresh")]
    room.network.clock.advance(2)
    assert room.other.ask(["shop/*"], 20) == []
    assert room.other.present("alive/**", 0) == []


def test_a_message_may_be_lost_while_its_ends_stay_linked(room: Room) -> None:
    end = room.network.lose(lambda passage: passage.payload == b"b")
    room.say(*"abc")
    end()
    room.say("b")
    room.network.clock.advance(10)
    assert heard(room.ear) == [b"a", b"c", b"b"]
    assert heard(room.signs) == []


def test_signs_of_the_killed_fall_at_once_and_what_it_sent_is_lost(room: Room) -> None:
    announcements = room.other.announcements("shop/**")
    room.one.announce("shop/bread", b"fresh")
    room.network.delay(0.1)
    room.say("lost")
    room.one.announce("shop/bread", b"lost")
    room.network.kill(room.one.node)
    room.network.traffic.settle()
    assert (heard(room.ear), heard(room.signs), heard(announcements)) == ([], [None], [b"fresh"])
    with pytest.raises(ChannelClosed):
        room.one.announce("shop/bread", b"stale")
    for thing in (room.sign, room.one):
        thing.close()


def test_killing_or_cutting_off_a_dead_container_does_nothing(room: Room) -> None:
    room.one.close()
    room.network.kill(room.one.node)
    room.cut()
    room.network.heal()
    assert heard(room.signs) == [None]


def test_a_transport_that_closes_while_it_is_cut_off_is_lost_with_its_lease(room: Room) -> None:
    room.cut()
    room.one.close()
    assert heard(room.signs) == []
    room.network.clock.advance(2)
    room.network.heal()
    assert heard(room.signs) == [None]


def test_a_tap_sees_each_message_before_it_is_sent_and_after_it_arrived(room: Room) -> None:
    seen: list[InFlightMessage] = []
    end = room.network.tap(seen.append)
    room.say("word")
    end()
    room.say("unseen")
    assert [(passage.arrived, passage.source, passage.target, passage.payload) for passage in seen] == [
        (False, "one", "other", b"word"),
        (True, "one", "other", b"word"),
    ]


def test_a_tap_may_kill_the_receiver_before_a_message_arrives(room: Room) -> None:
    seen: list[bool] = []

    def kill(passage: InFlightMessage) -> None:
        seen.append(passage.arrived)
        room.network.kill(room.other.node)

    room.network.tap(kill)
    room.say("word")
    assert seen == [False]
    with pytest.raises(ChannelClosed):
        room.ear.receive()


def test_messages_are_counted_by_kind_and_only_those_that_go_somewhere(room: Room) -> None:
    before = room.network.sent.copy()
    room.say("a", "b")
    room.say("unheard", key="elsewhere")
    room.say("stop", urgent=True)
    room.other.wake("room/a", b"")
    assert room.network.sent - before == {MessageKind.PUT: 2, MessageKind.URGENT: 1}
    assert Message("room/a", b"a") == room.ear.receive()
