"""Who reads and who runs the calls of a connection on which many are under way."""

import queue
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from trade._threads import channel_workers
from trade._threads.quick_workers import _LOOK_S, QuickWorkerPool
from trade.testing import VirtualTime
from trade.transport.base import Channel, ChannelClosed, Message

pytestmark = pytest.mark.virtual_time

QUICK, SLOW, SUDDEN = (Message(f"call/{kind}", b"") for kind in ("quick", "slow", "sudden"))
"""A slow call passes the reading on, as its kind is known; a sudden one is slow where a quick one was expected."""
BETWEEN_S = 0.0001


class Queue(Channel):
    def __init__(self) -> None:
        self.waiting: queue.SimpleQueue[Message | None] = queue.SimpleQueue()

    def receive(self) -> Message:
        message = self.waiting.get(timeout=60)
        if message is None:
            self.close()
            raise ChannelClosed
        return message

    def close(self) -> None:
        self.waiting.put(None)


class Calls:
    """Records when each call began, and on which thread. Slow and sudden ones last until they may end."""

    def __init__(self) -> None:
        self.began: list[tuple[str, float, int]] = []
        self.kept = 0
        """How many had another thread to pass the reading on to."""
        self.may_end = threading.Event()
        self.refused = threading.Event()

    def run(self, message: Message, *, pass_on: Callable[[], None] | None = None) -> None:
        self.kept += pass_on is not None
        kind = message.key.rpartition("/")[2]
        if kind == "slow" and pass_on is not None:
            pass_on()
        self.began.append((kind, time.monotonic(), threading.get_ident()))
        if kind != "quick":
            self.may_end.wait(60)
        threading.Event().wait(BETWEEN_S / 10)  # as an answer does, it lets others run

    def refuse(self, _message: Message) -> None:
        self.refused.set()


@pytest.fixture
def channel() -> Iterator[Queue]:
    made = Queue()
    yield made
    made.close()


@pytest.fixture
def calls() -> Iterator[Calls]:
    made = Calls()
    yield made
    made.may_end.set()


@pytest.fixture
def pool(channel: Queue, calls: Calls) -> Iterator[QuickWorkerPool]:
    """A pool in which one thread reads while another watches it, because many calls have come."""
    if VirtualTime.current() is None:
        pytest.skip("it judges by moments: on the real clock, threads also wait for a processor")
    made = QuickWorkerPool("quick", channel, calls.run, calls.refuse)
    for _ in range(20):
        channel.waiting.put(QUICK)
    wait_for(calls, 20)
    assert made._watched
    yield made
    calls.may_end.set()
    made.close()
    made.wait(20)
    assert not any(thread.name.startswith("quick-") for thread in threading.enumerate())


def wait_for(calls: Calls, count: int) -> None:
    until_s = time.monotonic() + 20
    while len(calls.began) < count:
        assert time.monotonic() < until_s, calls.began
        time.sleep(BETWEEN_S / 10)


def wait_until_none_works(pool: QuickWorkerPool) -> None:
    until_s = time.monotonic() + 20
    while pool.working:
        assert time.monotonic() < until_s
        time.sleep(BETWEEN_S)


def test_quick_calls_that_follow_each_other_run_on_the_thread_that_reads(
    pool: QuickWorkerPool, channel: Queue, calls: Calls
) -> None:
    for _ in range(50):
        channel.waiting.put(QUICK)
    wait_for(calls, 70)
    assert len({thread for _, _, thread in calls.began[20:]}) == 1
    assert calls.kept >= 50


def test_calls_behind_one_that_is_slow_wait_for_a_moment_at_most(
    pool: QuickWorkerPool, channel: Queue, calls: Calls
) -> None:
    channel.waiting.put(SUDDEN)
    channel.waiting.put(QUICK)
    wait_for(calls, 22)
    (_, sudden_s, sudden_thread), (_, next_s, next_thread) = calls.began[20:]
    assert sudden_thread != next_thread
    assert next_s - sudden_s <= 2 * _LOOK_S + BETWEEN_S


def test_calls_that_are_known_to_be_slow_begin_together(pool: QuickWorkerPool, channel: Queue, calls: Calls) -> None:
    for _ in range(3):
        channel.waiting.put(SLOW)
    wait_for(calls, 23)
    slow = calls.began[20:]
    assert len({thread for _, _, thread in slow}) == 3
    assert slow[-1][1] - slow[0][1] < BETWEEN_S


def test_slow_calls_come_back_and_take_further_ones(pool: QuickWorkerPool, channel: Queue, calls: Calls) -> None:
    for _ in range(30):
        channel.waiting.put(SUDDEN)
    wait_for(calls, 50)
    assert pool.working == 30
    calls.may_end.set()
    for _ in range(30):
        channel.waiting.put(QUICK)
    wait_for(calls, 80)
    wait_until_none_works(pool)
    assert sum(thread.name.startswith("quick-") for thread in threading.enumerate()) <= channel_workers._FEW


def test_at_the_limit_further_calls_are_refused_and_the_channel_is_read(
    pool: QuickWorkerPool, channel: Queue, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channel_workers, "MOST_THREADS", 6)
    for message in (SUDDEN, SLOW, SUDDEN, SLOW, SUDDEN):
        channel.waiting.put(message)
    wait_for(calls, 25)
    channel.waiting.put(QUICK)
    assert calls.refused.wait(20)
    assert len(calls.began) == 25
    assert pool.draining
    calls.may_end.set()
    wait_until_none_works(pool)
    channel.waiting.put(QUICK)
    wait_for(calls, 26)


def test_no_thread_watches_where_nothing_arrives(pool: QuickWorkerPool, channel: Queue, calls: Calls) -> None:
    time.sleep(10 * _LOOK_S)
    assert not pool._watched
    channel.waiting.put(SUDDEN)
    channel.waiting.put(QUICK)
    wait_for(calls, 22)
    (_, sudden_s, _), (_, next_s, _) = calls.began[20:]
    assert next_s == pytest.approx(sudden_s, abs=BETWEEN_S), "another thread reads before the call runs"


def test_a_call_that_runs_on_the_reader_at_the_end_is_waited_for(
    pool: QuickWorkerPool, channel: Queue, calls: Calls
) -> None:
    channel.waiting.put(SUDDEN)
    wait_for(calls, 21)
    assert pool.working == 1
    pool.close()
    pool.wait(0.01)
    assert pool.working == 1, "it continues"
    calls.may_end.set()
    pool.wait(20)
    assert pool.working == 0
