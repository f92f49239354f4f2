"""Waiting that an interrupt may end at any instant."""

import threading
import time

import pytest

from trade._threads.condition import InterruptibleCondition

pytestmark = pytest.mark.virtual_time


def test_notify_all_wakes_all_waiting_threads() -> None:
    bell, rung, woken = InterruptibleCondition(), threading.Event(), threading.Semaphore(0)

    def wait() -> None:
        if bell.wait_for(rung.is_set, 20):
            woken.release()

    threads = [threading.Thread(target=wait) for _ in range(5)]
    for thread in threads:
        thread.start()
    rung.set()
    bell.notify_all()
    for thread in threads:
        thread.join(20)
    assert sum(woken.acquire(blocking=False) for _ in range(6)) == 5


def test_it_looks_at_once_and_gives_up_in_time() -> None:
    bell = InterruptibleCondition()
    assert bell.wait_for(lambda: True, 0)
    assert not bell.wait_for(lambda: False, 0)
    assert not bell.wait_for(lambda: False, 0.01)


def test_a_ring_between_looking_and_waiting_is_not_missed() -> None:
    bell, looks = InterruptibleCondition(), list[float]()

    def ready() -> bool:
        looks.append(time.monotonic())
        if len(looks) == 1:
            bell.notify_all()
            return False
        return True

    assert bell.wait_for(ready, 20)
    assert len(looks) == 2


def test_a_condition_keeps_no_waiter_after_its_wait() -> None:
    bell = InterruptibleCondition()
    bell.wait_for(lambda: False, 0)
    assert not bell._gates


def test_an_error_of_what_is_looked_at_is_the_waiters() -> None:
    bell = InterruptibleCondition()
    with pytest.raises(ZeroDivisionError):
        bell.wait_for(lambda: bool(1 / 0), 1)
    assert not bell._gates
