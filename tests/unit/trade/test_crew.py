"""How many threads a channel of calls has."""

import threading
import time
from collections.abc import Callable
from statistics import median

import pytest

from tests.unit.trade.conftest import QueueChannel
from trade._threads.channel_workers import _MOMENT_S, MOST_THREADS, WorkerPool
from trade.testing import VirtualTime
from trade.transport.base import Message

pytestmark = pytest.mark.virtual_time

CALL = Message("call/a/b", b"")


def test_very_many_quick_calls_are_taken_by_few_threads(channel: QueueChannel) -> None:
    done = threading.Semaphore(0)
    at_once: list[int] = []

    def work(_message: Message) -> None:
        at_once.append(sum(thread.name.startswith("quick-") for thread in threading.enumerate()))
        threading.Event().wait(0.0002)  # as an answer does, it lets others run
        done.release()

    for _ in range(3000):
        channel.waiting.put(CALL)
    crew = WorkerPool("quick", channel, work, refuse=work)
    for _ in range(3000):
        assert done.acquire(timeout=60)
    assert median(at_once) < MOST_THREADS // 2
    crew.close()
    crew.wait(20)


def test_slow_calls_get_a_thread_each_which_ends_with_them(
    channel: QueueChannel, eventually: Callable[[Callable[[], bool]], bool]
) -> None:
    inside, leave, refused = threading.Semaphore(0), threading.Event(), threading.Event()

    def work(_message: Message) -> None:
        inside.release()
        leave.wait(60)

    crew = WorkerPool("slow", channel, work, refuse=lambda _message: refused.set())
    for _ in range(MOST_THREADS - 1):
        channel.waiting.put(CALL)
    for _ in range(MOST_THREADS - 1):
        assert inside.acquire(timeout=20)
    channel.waiting.put(CALL)
    assert refused.wait(20)
    assert crew.draining
    leave.set()
    assert eventually(lambda: sum(thread.name.startswith("slow-") for thread in threading.enumerate()) == 4)
    crew.close()
    crew.wait(20)


@pytest.mark.parametrize(("count", "most_s"), [(7, 0.0), (30, _MOMENT_S)])
def test_slow_calls_that_come_together_begin_together(channel: QueueChannel, count: int, most_s: float) -> None:
    """Seven joints of an arm that are started one by one: none waits for the ones before it."""
    if VirtualTime.current() is None:
        pytest.skip("on the real clock, threads also wait for a processor")
    inside, leave = threading.Semaphore(0), threading.Event()

    def work(_message: Message) -> None:
        inside.release()
        leave.wait(60)

    crew = WorkerPool("slow", channel, work, refuse=work)
    began_s = time.monotonic()
    for _ in range(count):
        channel.waiting.put(CALL)
    for _ in range(count):
        assert inside.acquire(timeout=20)
    assert time.monotonic() - began_s == pytest.approx(most_s, abs=1e-3)
    leave.set()
    crew.close()
    crew.wait(20)
