"""Who reads and who runs the calls of a connection on which many are under way."""

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.conftest import QueueChannel
from trade._threads import channel_workers
from trade._threads.quick_workers import _LOOK_S, QuickWorkerPool
from trade.testing import VirtualTime
from trade.transport.base import Message

pytestmark = pytest.mark.virtual_time

QUICK, SLOW, SUDDEN = (Message(f"call/{kind}", b"") for kind in ("quick", "slow", "sudden"))
"""A slow call passes the reading on, as its kind is known; a sudden one is slow where a quick one was expected."""
BETWEEN_S = 0.0001


class Calls:
    """Records when each call began, and on which thread. Slow and sudden ones last until they may end."""

    def __init__(self) -> None:
        self.began: list[tuple[str, float, int]] = []
        self._begin = threading.Semaphore(0)
        self._seen = 0
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
        self._begin.release()
        if kind != "quick":
            self.may_end.wait(60)
        threading.Event().wait(BETWEEN_S / 10)  # as an answer does, it lets others run

    def wait_for(self, count: int) -> None:
        """Waits until so many have begun."""
        while self._seen < count:
            assert self._begin.acquire(timeout=20), self.began
            self._seen += 1

    def forget(self) -> None:
        """Records from now on."""
        self.began.clear()
        self._seen = self.kept = 0

    def refuse(self, _message: Message) -> None:
        self.refused.set()


@pytest.fixture
def calls() -> Iterator[Calls]:
    made = Calls()
    yield made
    made.may_end.set()


@pytest.fixture
def pool(channel: QueueChannel, calls: Calls) -> Iterator[QuickWorkerPool]:
    """A pool in which one thread reads while another watches it, because many calls have come."""
    if VirtualTime.current() is None:
        pytest.skip("it judges by moments: on the real clock, threads also wait for a processor")
    made = QuickWorkerPool("quick", channel, calls.run, calls.refuse)
    for _ in range(10):
        for _ in range(20):
            channel.waiting.put(QUICK)
        calls.wait_for(20)
        calls.forget()
        threading.Event().wait(BETWEEN_S)  # the last ones end
        if made._watched:
            break
    assert made._watched
    yield made
    calls.may_end.set()
    made.close()
    made.wait(20)
    for thread in threading.enumerate():
        if thread.name.startswith("quick-"):  # one that left the pool by itself may be on its way out
            thread.join(20)
    assert not any(thread.name.startswith("quick-") for thread in threading.enumerate())


def test_quick_calls_that_follow_each_other_run_on_the_thread_that_reads(
    pool: QuickWorkerPool, channel: QueueChannel, calls: Calls
) -> None:
    for _ in range(50):
        channel.waiting.put(QUICK)
    calls.wait_for(50)
    assert len({thread for _, _, thread in calls.began}) == 1
    assert calls.kept >= 50


def test_calls_behind_one_that_is_slow_wait_for_a_moment_at_most(
    pool: QuickWorkerPool, channel: QueueChannel, calls: Calls
) -> None:
    channel.waiting.put(SUDDEN)
    channel.waiting.put(QUICK)
    calls.wait_for(2)
    (_, sudden_s, sudden_thread), (_, next_s, next_thread) = calls.began
    assert sudden_thread != next_thread
    assert next_s - sudden_s <= 2 * _LOOK_S + BETWEEN_S


def test_calls_that_are_known_to_be_slow_begin_together(
    pool: QuickWorkerPool, channel: QueueChannel, calls: Calls
) -> None:
    for _ in range(3):
        channel.waiting.put(SLOW)
    calls.wait_for(3)
    slow = calls.began
    assert len({thread for _, _, thread in slow}) == 3
    assert slow[-1][1] - slow[0][1] < BETWEEN_S


def test_slow_calls_come_back_and_take_further_ones(pool: QuickWorkerPool, channel: QueueChannel, calls: Calls) -> None:
    for _ in range(30):
        channel.waiting.put(SUDDEN)
    calls.wait_for(30)
    assert pool.working == 30
    calls.may_end.set()
    for _ in range(30):
        channel.waiting.put(QUICK)
    calls.wait_for(60)
    wait_until(lambda: not pool.working, "their calls have ended")
    assert sum(thread.name.startswith("quick-") for thread in threading.enumerate()) <= channel_workers._FEW


def test_at_the_limit_further_calls_are_refused_and_the_channel_is_read(
    pool: QuickWorkerPool, channel: QueueChannel, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channel_workers, "MOST_THREADS", 6)
    for message in (SUDDEN, SLOW, SUDDEN, SLOW, SUDDEN):
        channel.waiting.put(message)
    calls.wait_for(5)
    channel.waiting.put(QUICK)
    assert calls.refused.wait(20)
    assert len(calls.began) == 5
    assert pool.draining
    calls.may_end.set()
    wait_until(lambda: not pool.working, "their calls have ended")
    channel.waiting.put(QUICK)
    calls.wait_for(6)


def test_no_thread_watches_where_nothing_arrives(pool: QuickWorkerPool, channel: QueueChannel, calls: Calls) -> None:
    wait_until(lambda: not pool._watched, "it stops watching")
    channel.waiting.put(SUDDEN)
    channel.waiting.put(QUICK)
    calls.wait_for(2)
    (_, sudden_s, _), (_, next_s, _) = calls.began
    assert next_s == pytest.approx(sudden_s, abs=BETWEEN_S), "another thread reads before the call runs"


def test_a_call_that_runs_on_the_reader_at_the_end_is_waited_for(
    pool: QuickWorkerPool, channel: QueueChannel, calls: Calls
) -> None:
    channel.waiting.put(SUDDEN)
    calls.wait_for(1)
    assert pool.working == 1
    pool.close()
    pool.wait(0.01)
    assert pool.working == 1, "it continues"
    calls.may_end.set()
    pool.wait(20)
    assert pool.working == 0
