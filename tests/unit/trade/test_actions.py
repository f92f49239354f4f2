"""Calls that take a while: they tell how far they are, and end early when their caller wants that."""

import asyncio
import threading
import time
from typing import Any

import pytest
from msgspec import Raw, Struct

import trade
from tests.support.waiting import wait_until
from trade import Container, current_call, service
from trade.errors import Cancelled, NotSerialisable
from trade.protocol.keys import call_key, reply_key
from trade.protocol.messages import (
    EMPTY_ARGUMENTS,
    PROTOCOL,
    Call,
    CancelArguments,
    Status,
    decode_reply,
    encode_message,
)


class Share(Struct):
    share: float
    left: list[int]


class Walk:
    def __init__(self) -> None:
        self.entered, self.open, self.cancelled = threading.Event(), threading.Event(), threading.Event()
        self.begun = 0

    @service
    def walk(self) -> str:
        self.begun += 1
        self.entered.set()
        self.open.wait(20)
        return "arrived"

    @service
    def tell(self, values: list[int]) -> str:
        for value in values:
            trade.progress({"share": value})
        self.open.wait(20)
        return "arrived"

    @service
    def tell_record(self) -> None:
        trade.progress(Share(share=0.5, left=[1, 2]))
        self.open.wait(20)

    @service
    def tell_nonsense(self) -> None:
        trade.progress(object())

    @service
    def heed(self) -> str:
        call = current_call()
        assert call is not None
        self.entered.set()
        assert call.wait_cancelled(20)
        assert call.cancelled
        self.cancelled.set()
        call.raise_if_cancelled()
        return "not reached"

    @service
    def finish_nicely(self) -> str:
        call = current_call()
        assert call is not None
        reported = threading.Event()
        call.on_cancel(reported.set)
        self.entered.set()
        assert reported.wait(20)
        return "half way"

    @service
    async def heed_async(self) -> None:
        self.entered.set()
        try:
            await asyncio.Event().wait()
        finally:
            self.cancelled.set()


@pytest.fixture
def walk() -> Any:
    walk = Walk()
    yield walk
    walk.open.set()


def test_a_caller_sees_the_latest_progress(offer: Any, walk: Walk, eventually: Any) -> None:
    run = offer(walk)("tell").start([1, 2, 3])
    assert eventually(lambda: run.progress() == {"share": 3})
    walk.open.set()
    assert run.result(20) == "arrived"
    assert run.progress() == {"share": 3}


def test_a_run_shows_what_it_is_and_how_far(offer: Any, walk: Walk) -> None:
    run = offer(walk)("walk").start()
    assert repr(run) == "<Run of robot.walk, under way>"
    walk.open.set()
    run.result(20)
    assert repr(run) == "<Run of robot.walk, ended>"


def test_the_last_progress_report_comes_before_the_answer(offer: Any, walk: Walk) -> None:
    walk.open.set()
    tell = offer(walk)("tell")
    for _ in range(20):
        run = tell.start([1, 2, 3])
        assert run.result(20) == "arrived"
        assert run.progress() == {"share": 3}


def test_a_call_that_says_nothing_has_no_progress(offer: Any, walk: Walk) -> None:
    run = offer(walk)("walk").start()
    assert run.progress() is None
    walk.open.set()
    assert run.result(20) == "arrived"


def test_progress_costs_a_blocking_call_nothing(offer: Any, walk: Walk) -> None:
    walk.open.set()
    assert offer(walk)("tell")([1, 2, 3]) == "arrived"


def test_progress_outside_of_a_call_goes_nowhere(walk: Walk) -> None:
    walk.open.set()
    assert walk.tell([1]) == "arrived"


def test_progress_that_cannot_be_sent_is_the_providers_fault(offer: Any, walk: Walk) -> None:
    with pytest.raises(NotSerialisable, match=r"robot.tell_nonsense: its progress cannot be sent"):
        offer(walk)("tell_nonsense").start().result(20)


def test_progress_is_sent_at_most_every_fifty_milliseconds(
    here: Container, there: Container, walk: Walk, monkeypatch: pytest.MonkeyPatch, eventually: Any
) -> None:
    there.register(walk, "robot")
    sent: list[int] = []
    answer = there._parts.dispatcher._answer

    def note(*args: Any) -> None:
        sent.append(args[1])
        answer(*args)

    monkeypatch.setattr(there._parts.dispatcher, "_answer", note)
    began = time.monotonic()
    run = here.find(trade.where(name="tell"), wait_s=20).start(list(range(20_000)))
    assert eventually(lambda: run.progress() == {"share": 19_999})
    took_s = time.monotonic() - began
    assert sent.count(Status.PROGRESS) <= took_s / 0.05 + 2
    walk.open.set()
    run.result(20)


@pytest.mark.parametrize("name", ["heed", "heed_async"])
def test_a_cancelled_call_ends_as_its_provider_sees_fit(offer: Any, walk: Walk, name: str) -> None:
    run = offer(walk)(name).start()
    assert walk.entered.wait(20)
    run.cancel()
    with pytest.raises(Cancelled, match=rf"the call of robot.{name} was cancelled"):
        run.result(20)
    assert walk.cancelled.is_set()


def test_a_provider_may_answer_a_cancelled_call(offer: Any, walk: Walk) -> None:
    run = offer(walk)("finish_nicely").start()
    assert walk.entered.wait(20)
    run.cancel()
    run.cancel()
    assert run.result(20) == "half way"
    run.cancel()


def test_a_progress_record_arrives_as_plain_data(offer: Any, walk: Walk) -> None:
    run = offer(walk)("tell_record").start()
    wait_until(lambda: run.progress() is not None)
    walk.open.set()
    run.result(20)
    assert run.progress() == {"share": 0.5, "left": [1, 2]}


def test_a_service_that_ignores_cancellation_runs_to_its_end(offer: Any, walk: Walk) -> None:
    run = offer(walk)("walk").start()
    assert walk.entered.wait(20)
    run.cancel()
    walk.open.set()
    assert run.result(20) == "arrived"


@pytest.mark.parametrize("name", ["heed", "heed_async"])
def test_cancelling_the_task_that_awaits_a_call_cancels_the_call(offer: Any, walk: Walk, name: str) -> None:
    handle = offer(walk)(name)

    async def give_up() -> None:
        task = asyncio.create_task(handle.acall())
        await asyncio.to_thread(walk.entered.wait, 20)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(give_up())
    assert walk.cancelled.wait(20)


@pytest.mark.parametrize("caller", ["tester", "mallory"])
def test_a_cancellation_that_overtakes_its_call_still_counts_and_only_the_callers_own_does(
    here: Container, open_raw: Any, walk: Walk, caller: str
) -> None:
    key = here.register(walk, "robot")[0].key
    raw = open_raw(here)
    replies = {who: raw.subscribe(reply_key(here.address.identity, who, "raw", "0")) for who in {"tester", caller}}
    cancel = encode_message(CancelArguments(7, "robot.walk", 5.0))
    stop = Call(PROTOCOL, 1, "cancel", "raw/0", f"{caller}/raw/0", None, (), Raw(cancel))
    raw.publish(call_key(caller, key.address, "trade", "system", stop=True)).put(encode_message(stop))
    assert decode_reply(replies[caller].receive().payload).status == Status.OK
    walk.open.set()
    call = Call(PROTOCOL, 7, "walk", "raw/0", "tester/raw/0", 2**62, (), EMPTY_ARGUMENTS)
    raw.publish(call_key("tester", key.address, key.domain, key.provider, stop=False)).put(encode_message(call))
    reply = decode_reply(replies["tester"].receive().payload)
    assert (reply.status, walk.begun) == ((Status.ERROR, 0) if caller == "tester" else (Status.OK, 1))


@pytest.mark.parametrize("cancel", [b"\xc0", b"\x93\x01\xa1a\xff"], ids=["nil", "negative"])
def test_a_malformed_cancellation_is_an_error(here: Container, open_raw: Any, cancel: bytes) -> None:
    raw = open_raw(here)
    replies = raw.subscribe(reply_key(here.address.identity, "tester", "raw", "0"))
    stop = Call(PROTOCOL, 1, "cancel", "raw/0", "tester/raw/0", None, (), Raw(cancel))
    raw.publish(call_key("tester", here.address, "trade", "system", stop=True)).put(encode_message(stop))
    assert decode_reply(replies.receive().payload or b"").status == Status.ERROR


class Heeding:
    """Waits for its cancellation once it is cancelled already."""

    def __init__(self) -> None:
        self.entered, self.waited = threading.Event(), threading.Event()
        self.cancelled = False

    @service
    def heed_late(self) -> None:
        call = current_call()
        assert call is not None
        self.entered.set()
        while not call.cancelled:
            time.sleep(0.01)
        self.cancelled = call.wait_cancelled(20)
        self.waited.set()


@pytest.mark.virtual_time
def test_waiting_for_a_cancellation_that_was_before_ends_at_once(offer: Any) -> None:
    heeding = Heeding()
    run = offer(heeding)("heed_late").start()
    assert heeding.entered.wait(20)
    run.cancel()
    cancelled_at = time.monotonic()
    assert heeding.waited.wait(30)
    assert heeding.cancelled
    assert time.monotonic() - cancelled_at < 1
