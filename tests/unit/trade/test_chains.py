"""What ends a call ends the calls that it makes, of synchronous services as of asynchronous ones."""

import asyncio
import threading
from contextlib import suppress
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, current_call, service, where
from trade.errors import Cancelled, OutcomeUnknown

pytestmark = pytest.mark.virtual_time


def found(container: Container, name: str) -> Handle:
    return container.find(where(name=name, group="robot"), wait_s=20)


class Leaf:
    """Heeds neither its deadline nor that it is cancelled: it ends by its stop."""

    def __init__(self) -> None:
        self.entered, self.stopped, self.cancelled = threading.Event(), threading.Event(), threading.Event()
        self.begun = 0

    @service(cancel="stop")
    def go(self) -> None:
        self.begun += 1
        self.entered.set()
        self.stopped.wait(30)

    @service(effect="read")
    def look(self) -> int:
        return self.begun

    @service(cancel="stop")
    def heed(self) -> None:
        call = current_call()
        assert call is not None
        self.entered.set()
        assert call.wait_cancelled(30)
        self.cancelled.set()

    @service(effect="stop")
    def stop(self) -> None:
        self.stopped.set()


class Outer:
    def __init__(self) -> None:
        self.outcomes: list[Any] = []
        self.ended = threading.Event()

    def _note(self, handle: Handle) -> None:
        try:
            self.outcomes.append(handle())
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.outcomes.append(error)

    @service
    def relay(self, handles: list[Handle]) -> None:
        for handle in handles:
            self._note(handle.with_(deadline_s=60))
        self.ended.set()

    @service(serial=True)
    def relay_serially(self, handles: list[Handle]) -> None:
        self.relay(handles)

    @service
    async def relay_async(self, handles: list[Handle]) -> None:
        try:
            for handle in handles:
                await handle.acall()
        finally:
            await asyncio.to_thread(self._note, handles[0])
            self.ended.set()

    @service(effect="read")
    def watched(self, handle: Handle, times: int) -> None:
        call = current_call()
        assert call is not None
        assert call.ongoing is not None
        for _ in range(times):
            handle()
            handle.start().result(20)
        ongoing = call.ongoing
        wait_until(lambda: not ongoing._on_cancel)  # the thread that ended the last one takes it out


@pytest.fixture
def outer(there: Container) -> Outer:
    outer = Outer()
    there.register(outer, "robot")
    return outer


@pytest.fixture(params=["beside the service", "elsewhere"])
def leaf(request: pytest.FixtureRequest, here: Container, there: Container) -> Leaf:
    leaf = Leaf()
    (there if request.param == "beside the service" else here).register(leaf, "robot")
    return leaf


@pytest.mark.parametrize("how", ["relay", "relay_serially"])
def test_cancelling_reaches_what_a_service_waits_for(here: Container, outer: Outer, leaf: Leaf, how: str) -> None:
    go, look = found(here, "go"), found(here, "look")
    run = found(here, how).with_(deadline_s=60).start([go, look, go])
    assert leaf.entered.wait(20)
    run.cancel()
    run.result(20)
    assert leaf.stopped.is_set()
    came, looked, refused = outer.outcomes
    assert (came, looked, leaf.begun) == (None, 1, 1)  # reading continues, and nothing is commanded any more
    assert isinstance(refused, Cancelled)


def test_an_inner_call_sees_the_cancellation_of_its_outer_call(here: Container, outer: Outer, leaf: Leaf) -> None:
    run = found(here, "relay").with_(deadline_s=60).start([found(here, "heed")])
    assert leaf.entered.wait(20)
    run.cancel()
    assert leaf.cancelled.wait(20)
    run.result(20)


def test_an_asynchronous_service_commands_nothing_after_it_was_cancelled(
    here: Container, outer: Outer, leaf: Leaf
) -> None:
    run = found(here, "relay_async").with_(deadline_s=60).start([found(here, "go")])
    assert leaf.entered.wait(20)
    run.cancel()
    assert outer.ended.wait(20)
    assert leaf.stopped.wait(20)
    assert (leaf.begun, type(outer.outcomes[0])) == (1, Cancelled)


@pytest.mark.parametrize("leaf", ["elsewhere"], indirect=True)
def test_the_deadline_calls_what_ends_a_call_that_does_not_end_by_itself(
    here: Container, outer: Outer, leaf: Leaf
) -> None:
    with suppress(OutcomeUnknown):  # or what the service in between says to that, which may be as quick
        found(here, "relay").with_(deadline_s=0.5)([found(here, "go")])
    assert leaf.stopped.wait(20)


def test_the_end_of_the_caller_ends_what_a_service_waits_for(
    here: Container, outer: Outer, leaf: Leaf, start_container: Any
) -> None:
    """Also where nothing is known of who asked: the service in between sees it."""
    person = start_container("person")
    found(person, "relay").with_(deadline_s=60).start([found(person, "heed")])
    assert leaf.entered.wait(20)
    person.close()
    assert leaf.cancelled.wait(20)
    wait_until(outer.ended.is_set)


def test_calls_that_have_ended_are_not_kept_by_the_one_that_made_them(
    here: Container, outer: Outer, leaf: Leaf
) -> None:
    found(here, "watched")(found(here, "look"), 20)
