"""The caller's side on a transport of paper: reply channels are lent on, and every wait ends for its own reason."""

import queue
import threading
import time
from collections.abc import Callable, Iterator

import msgspec
import pytest

from trade._calls.caller import Caller
from trade._calls.peer import Peer, Route
from trade._threads.scheduler import Scheduler
from trade.protocol.keys import Address
from trade.protocol.messages import EMPTY, EMPTY_ARGUMENTS, PROTOCOL, Call, Reply, Status, decode_call, encode_message
from trade.transport.base import Answer, Channel, ChannelClosed, Message, Publisher, Questions, Transport

pytestmark = pytest.mark.virtual_time

OWN = Address("me", "here", "e0")
OTHER = Address("arm", "driver", "e1")
SECOND_NS = 10**9


class PaperChannel(Channel):
    def __init__(self) -> None:
        self.queue: queue.SimpleQueue[Message | BaseException] = queue.SimpleQueue()

    def receive(self) -> Message:
        item = self.queue.get(timeout=30)
        if isinstance(item, BaseException):
            raise item
        return item

    def close(self) -> None:
        self.queue.put(ChannelClosed())


class PaperPublisher(Publisher):
    def __init__(self, transport: "PaperTransport") -> None:
        self.transport = transport
        self.closed = False

    def put(self, payload: bytes) -> None:
        if self.closed:
            raise ChannelClosed
        self.transport.on_call(payload)

    def close(self) -> None:
        self.closed = True


class PaperTransport(Transport):
    """Calls go to ``on_call``; the test puts the answers."""

    def __init__(self) -> None:
        self.channels: dict[str, PaperChannel] = {}
        self.wakes: list[tuple[str, int]] = []
        self.on_call: Callable[[bytes], None] = lambda payload: None

    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        return PaperPublisher(self)

    def subscribe(self, pattern: str, *, newest: int = 0) -> Channel:
        return self.channels.setdefault(pattern.removeprefix("reply/*/"), PaperChannel())

    def wake(self, key: str, payload: bytes) -> None:
        reply = msgspec.msgpack.decode(payload, type=Reply)
        self.wakes.append((key, reply.id))
        self.channels[key.split("/", 2)[2]].queue.put(Message(key, payload))

    def answer(self, call_id: int, box: str, status: int = Status.OK, speaker: str = "arm") -> None:
        payload = encode_message(Reply(PROTOCOL, call_id, status, 1, EMPTY))
        self.channels[f"me/{box}"].queue.put(Message(f"reply/{speaker}/me/{box}", payload))

    def announce(self, key: str, payload: bytes) -> None: ...
    def announcements(self, pattern: str) -> Channel: ...  # type: ignore[empty-body]
    def questions(self, pattern: str) -> Questions: ...  # type: ignore[empty-body]
    def ask(self, pattern: str, timeout_s: float) -> list[Answer]: ...  # type: ignore[empty-body]
    def appear(self, key: str) -> None: ...  # type: ignore[override]
    def presences(self, pattern: str) -> Channel: ...  # type: ignore[empty-body]
    def present(self, pattern: str, timeout_s: float) -> list[str]: ...  # type: ignore[empty-body]
    def close(self) -> None: ...


@pytest.fixture
def transport() -> PaperTransport:
    return PaperTransport()


@pytest.fixture
def caller(transport: PaperTransport) -> Iterator[Caller]:
    timers = Scheduler("trade-timers")
    caller = Caller(transport, OWN, timers)
    caller.lost(OTHER, back=True)
    yield caller
    caller.close()
    timers.close()


def ask(caller: Caller, *, deadline_s: float = 60, to: Address = OTHER) -> Reply:
    return caller.ask(go(caller), route(caller, to), time.monotonic_ns() + int(deadline_s * SECOND_NS))


def go(caller: Caller) -> Call:
    return caller.new_call("go", EMPTY_ARGUMENTS)


def route(caller: Caller, to: Address = OTHER) -> Route:
    return caller.route(caller.peer(to), "rosie", "Arm-1", stop=False)


def answered(transport: PaperTransport) -> Callable[[bytes], None]:
    def answer(payload: bytes) -> None:
        call = decode_call(payload)
        transport.answer(call.id, call.reply)

    return answer


def test_a_reply_channel_is_lent_on(caller: Caller, transport: PaperTransport) -> None:
    transport.on_call = answered(transport)
    assert [ask(caller).status for _ in range(5)] == [Status.OK] * 5
    assert len(transport.channels) == 1


def test_an_interrupted_call_gives_its_channel_back_and_its_late_answer_is_passed_over(
    caller: Caller, transport: PaperTransport
) -> None:
    interrupted: list[int] = []

    def interrupt(payload: bytes) -> None:
        call = decode_call(payload)
        interrupted.append(call.id)
        transport.channels[f"me/{call.reply}"].queue.put(KeyboardInterrupt())

    transport.on_call = interrupt
    with pytest.raises(KeyboardInterrupt):
        ask(caller)

    def answer_both(payload: bytes) -> None:
        call = decode_call(payload)
        transport.answer(interrupted[0], call.reply, Status.GONE)
        transport.answer(call.id, call.reply)

    transport.on_call = answer_both
    assert ask(caller).status == Status.OK
    assert len(transport.channels) == 1


def test_ending_a_wait_does_not_end_the_next_call_on_the_same_channel(
    caller: Caller, transport: PaperTransport
) -> None:
    """Between looking at a channel and ending its wait, it may be lent to the next call."""
    transport.on_call = answered(transport)
    ask(caller)
    [box] = caller._every
    gone, other = caller.peer(OTHER), caller.peer(Address("leg", "driver", "e1"))
    deadline_ns = time.monotonic_ns() + 60 * SECOND_NS
    box.waiting = (1, gone, deadline_ns)

    def lent_on_meanwhile(peer: Peer, _: float) -> bool:
        box.waiting = (2, other, deadline_ns)
        return peer is gone

    caller._end(lent_on_meanwhile, Status.LOST)
    assert [call_id for _, call_id in transport.wakes] == [1]
    assert caller._next_deadline_ns() == deadline_ns  # the next call keeps its deadline
    box.waiting = None


def test_a_call_past_its_deadline_is_ended_once(caller: Caller, transport: PaperTransport) -> None:
    assert ask(caller, deadline_s=0.01).status == Status.TIMED_OUT
    assert len(transport.wakes) == 1


def test_a_sooner_deadline_is_kept_while_a_later_one_is_watched(caller: Caller) -> None:
    later = threading.Thread(target=ask, args=(caller,), kwargs={"deadline_s": 0.5})
    later.start()
    assert ask(caller, deadline_s=0.02).status == Status.TIMED_OUT
    assert later.is_alive()
    later.join(20)


def test_the_loss_of_a_container_ends_what_waits_for_it_and_nothing_else(
    caller: Caller, transport: PaperTransport
) -> None:
    statuses: dict[str, int] = {}
    sent = threading.Semaphore(0)
    calls = []

    def note(payload: bytes) -> None:
        calls.append(decode_call(payload))
        sent.release()

    transport.on_call = note
    neighbour = Address("arm", "other", "e1")
    caller.lost(neighbour, back=True)
    threads = [
        threading.Thread(target=lambda to=to: statuses.update({to.container: ask(caller, to=to).status}))
        for to in (OTHER, neighbour)
    ]
    for thread in threads:
        thread.start()
        assert sent.acquire(timeout=20)
    caller.lost(OTHER)
    threads[0].join(20)
    assert statuses == {"driver": Status.LOST}
    transport.answer(calls[1].id, calls[1].reply)
    threads[1].join(20)
    assert statuses["other"] == Status.OK


def test_a_call_to_a_lost_container_is_not_sent_until_it_is_back(caller: Caller, transport: PaperTransport) -> None:
    sent: list[bytes] = []
    transport.on_call = sent.append
    caller.lost(OTHER)
    assert ask(caller).status == Status.UNSENT
    assert sent == []
    caller.lost(OTHER, back=True)
    transport.on_call = answered(transport)
    assert ask(caller).status == Status.OK


def test_a_call_whose_publisher_went_with_its_provider_is_not_sent(caller: Caller, transport: PaperTransport) -> None:
    gone = route(caller)
    caller.publishers.forget(OTHER, "rosie", "Arm-1")
    deadline_ns = time.monotonic_ns() + 60 * SECOND_NS
    assert caller.ask(go(caller), gone, deadline_ns).status == Status.UNSENT
    started: list[Reply] = []
    caller.start(go(caller), gone, deadline_ns, started.append)
    assert [reply.status for reply in started] == [Status.UNSENT]


def test_closing_ends_blocked_and_started_calls_and_refuses_more(caller: Caller, transport: PaperTransport) -> None:
    sent = threading.Semaphore(0)
    transport.on_call = lambda _: sent.release()
    ended: list[int] = []
    blocked = threading.Thread(target=lambda: ended.append(ask(caller).status))
    blocked.start()
    assert sent.acquire(timeout=20)
    deadline_ns = time.monotonic_ns() + 60 * SECOND_NS
    caller.start(go(caller), route(caller), deadline_ns, lambda reply: ended.append(reply.status))
    caller.close()
    blocked.join(20)
    assert ended == [Status.CLOSED] * 2
    assert ask(caller).status == Status.UNSENT
    caller.close()


def test_a_failing_receiver_of_an_answer_disturbs_no_other(
    caller: Caller, transport: PaperTransport, caplog: pytest.LogCaptureFixture
) -> None:
    transport.on_call = answered(transport)
    deadline_ns, heard = time.monotonic_ns() + 60 * SECOND_NS, threading.Event()

    def fail(_: Reply) -> None:
        raise ValueError("no")

    caller.start(go(caller), route(caller), deadline_ns, fail)
    caller.start(go(caller), route(caller), deadline_ns, lambda _: heard.set())
    assert heard.wait(20)
    assert "the callback of an answer failed" in caplog.text


def test_an_unknown_clock_gives_no_expiry() -> None:
    peer = Peer(OTHER)
    assert not peer.clock_known
    assert peer.expiry_ns(SECOND_NS) is None


@pytest.mark.parametrize("offset_ns", [0, 5 * SECOND_NS, -5 * SECOND_NS, 10**15])
def test_an_expiry_is_never_later_than_meant_and_at_most_a_round_trip_early(offset_ns: int) -> None:
    peer = Peer(OTHER)
    now = time.monotonic_ns()
    round_trip_ns = 1_000_000
    peer.heard(now + offset_ns - round_trip_ns // 3, now - round_trip_ns, now)
    deadline_ns = now + SECOND_NS
    expiry_ns = peer.expiry_ns(deadline_ns)
    assert expiry_ns is not None
    meant_ns = deadline_ns + offset_ns
    assert meant_ns - 2 * round_trip_ns - SECOND_NS <= expiry_ns <= meant_ns


def test_a_shorter_round_trip_improves_the_clock_offset_estimate() -> None:
    peer = Peer(OTHER)
    now = time.monotonic_ns()
    peer.heard(now - 50_000_000, now - 100_000_000, now)
    rough = peer.expiry_ns(0)
    peer.heard(now - 500_000, now - 1_000_000, now)
    better = peer.expiry_ns(0)
    peer.heard(now - 50_000_000, now - 100_000_000, now)
    assert rough is not None
    assert better is not None
    assert better > rough
    assert abs((peer.expiry_ns(0) or 0) - better) < 10_000_000


def test_the_clock_offset_of_a_peer_is_replaced_after_a_jump() -> None:
    peer = Peer(OTHER)
    now = time.monotonic_ns()
    peer.heard(now, now - 1000, now)
    peer.heard(now - 3600 * SECOND_NS, now - 1000, now)
    expiry_ns = peer.expiry_ns(now)
    assert expiry_ns is not None
    assert expiry_ns <= now - 3600 * SECOND_NS + 1000


def test_a_lost_container_has_an_unknown_clock(caller: Caller) -> None:
    peer = caller.peer(OTHER)
    now = time.monotonic_ns()
    peer.heard(now, now - 1000, now)
    assert caller.peer(OTHER).clock_known
    caller.lost(OTHER)
    assert not caller.peer(OTHER).clock_known
    caller.lost(OTHER, back=True)
    assert not caller.peer(OTHER).clock_known


def test_nothing_is_kept_of_containers_that_have_ended(caller: Caller) -> None:
    for boot in range(300):
        address = Address("arm", "short-lived", f"e{boot}")
        caller.lost(address, back=True)
        assert not caller.peer(address).lost
        caller.lost(address)
        assert caller.peer(address).lost
    assert list(caller._peers) == [OTHER]
