"""A container that closes while something stops: the stop is waited for, and nothing is said of what is cut off."""

import asyncio
import logging
import threading
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, service, where
from trade.testing import MemorySystem

pytestmark = pytest.mark.virtual_time


class Lift:
    """Its stop takes a while, and longer than it takes a container to begin to close."""

    def __init__(self) -> None:
        self.entered, self.stopping, self.closing = threading.Event(), threading.Event(), threading.Event()
        self.stopped = 0

    @service(cancel="stop")
    def rise(self) -> None:
        self.entered.set()
        self.stopping.wait(20)

    @service(effect="stop")
    def stop(self) -> None:
        self.stopping.set()
        self.closing.wait(20)
        threading.Event().wait(0.3)
        self.stopped += 1


def _close(container: Container, lift: Lift) -> threading.Thread:
    closing = threading.Thread(target=container.close)
    closing.start()
    wait_until(container.lock_api.lease_client.is_closed, "it closes")
    lift.closing.set()
    return closing


def _rising(memory: MemorySystem) -> tuple[Lift, Container]:
    lift, me = Lift(), memory.container("me")
    memory.container("robot").register(lift, "lift")
    me.find(where(name="rise"), wait_s=20)
    return lift, me


def test_a_stop_that_is_under_way_is_waited_for(memory: MemorySystem, caplog: pytest.LogCaptureFixture) -> None:
    lift, me = _rising(memory)
    stop, outcome = me.find(where(name="stop", group="lift"), wait_s=20), list[Any]()
    stopper = threading.Thread(target=lambda: outcome.append(stop()))
    stopper.start()
    assert lift.stopping.wait(20)
    _close(me, lift).join(20)
    stopper.join(20)
    assert outcome == [None]


def test_the_stop_of_a_cancelled_task_is_waited_for(memory: MemorySystem, caplog: pytest.LogCaptureFixture) -> None:
    lift, me = _rising(memory)

    async def main() -> None:
        task = asyncio.create_task(me.find(where(name="rise"), wait_s=20).acall())
        await asyncio.to_thread(lift.entered.wait, 20)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    with caplog.at_level(logging.WARNING, "trade"):
        asyncio.run(main())
        _close(me, lift).join(20)
    assert lift.stopped == 1
    assert caplog.messages == []


def test_a_lock_callback_interrupted_by_closing_logs_no_warning(
    memory: MemorySystem, caplog: pytest.LogCaptureFixture
) -> None:
    _, me = _rising(memory)
    other, asked, closed, ended = memory.container("other"), threading.Event(), threading.Event(), threading.Event()
    stop = me.find(where(name="stop", group="lift"), wait_s=20)

    def asked_for(_who: str, _why: str) -> None:
        asked.set()
        closed.wait(20)
        try:
            stop()
        finally:
            ended.set()

    with caplog.at_level(logging.DEBUG, "trade"):
        me.lock(where(group="lift"), on_request=asked_for).acquire()
        other.request_release(where(group="lift"), "my turn")
        assert asked.wait(20)
        me.close()
        closed.set()
        assert ended.wait(20)
        wait_until(lambda: any("cut off, because its container closed" in one for one in caplog.messages))
    assert [one for one in caplog.records if one.levelno >= logging.WARNING] == []
