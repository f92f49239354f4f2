"""Calls by constraint, of many at once, and in a row."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest

import trade
from trade import BoundCall, Container, Outcome, service, where
from trade.errors import InvalidArgument, NoSuchService, NotSerialisable, ServiceGone, TooManyServices

pytestmark = pytest.mark.virtual_time


class Lamp:
    def __init__(self, level: int = 0) -> None:
        self.level = level

    @service
    def set_level(self, level: int) -> int:
        if level > 9:
            raise ValueError("too bright")
        self.level = level
        return level

    @service(effect="read")
    def get_level(self) -> int:
        return self.level

    @service
    def leave(self) -> None:
        raise SystemExit(3)


class Meeting:
    """Its service returns once so many are inside."""

    def __init__(self, size: int) -> None:
        self.barrier = threading.Barrier(size, timeout=20)

    @service
    def meet(self) -> bool:
        self.barrier.wait()
        return True


def test_a_constraint_is_called_like_the_one_service_it_means(here: Container, offer: Callable[..., Any]) -> None:
    offer(Lamp())("set_level")
    assert here.call(where(args=[int], returns=int), 5) == 5
    assert here.call(where(name="set_level"), level=6) == 6


def test_a_constraint_that_means_none_or_several_is_not_called(here: Container) -> None:
    lamps = [Lamp(), Lamp()]
    for lamp in lamps:
        here.register(lamp, "hall")
    with pytest.raises(TooManyServices):
        here.call(where(name="set_level"), 1)
    here.deregister(lamps[0])
    here.deregister(lamps[1])
    with pytest.raises(NoSuchService):
        here.call(where(name="set_level"), 1)


def test_all_are_called_at_once(here: Container, there: Container) -> None:
    meeting = Meeting(4)
    for container, name in ((here, "a"), (there, "b")):
        container.register(meeting, name)
    here.find(where(name="meet", group="b"), wait_s=20)
    outcomes = here.call_all([*here.services(where(name="meet")), *here.services(where(name="meet"))])
    assert [outcome.result for outcome in outcomes] == [True] * 4


def test_outcomes_come_in_order_with_results_and_errors(here: Container, offer: Callable[..., Any]) -> None:
    handle = offer(Lamp())("set_level")
    outcomes = here.call_all([handle.bind(1), handle.bind(10), handle, handle.bind("x"), handle.bind(object())], 3)
    assert [outcome.result for outcome in outcomes] == [1, None, 3, None, None]
    assert [type(outcome.error) for outcome in outcomes[1::2]] == [ValueError, InvalidArgument]
    assert isinstance(outcomes[4].error, NotSerialisable)
    assert [outcome.ok for outcome in outcomes] == [True, False, True, False, False]
    assert outcomes[0] == Outcome(handle, 1)
    assert outcomes[0].value() == 1
    with pytest.raises(ValueError, match="too bright"):
        outcomes[1].value()


def test_one_that_is_gone_or_ends_its_process_stops_no_other(here: Container, offer: Callable[..., Any]) -> None:
    get, lost = offer(Lamp(7))("get_level"), Lamp()
    gone = here.register(lost, "lost")[0]
    here.deregister(lost)
    leave = here.find(where(name="leave"))
    outcomes = here.call_all([gone.bind(1), leave, get])
    assert isinstance(outcomes[0].error, ServiceGone)
    assert outcomes[1].error is not None
    assert outcomes[2].result == 7


def test_hundreds_are_called_and_nothing_at_all_is_fine(here: Container) -> None:
    get = here.register(Lamp(4), "hall")[1]
    assert get.name == "get_level"
    assert [outcome.result for outcome in here.call_all([get] * 600)] == [4] * 600
    assert here.call_all(where(name="missing")) == here.call_all([]) == []


def test_a_sequence_stops_at_the_first_error(here: Container, offer: Callable[..., Any]) -> None:
    lamp = Lamp()
    handle = offer(lamp)("set_level")
    calls = [handle.bind(1), handle.bind(10), handle.bind(level=2)]
    assert [outcome.ok for outcome in here.call_sequence(calls)] == [True, False]
    assert lamp.level == 1
    assert [outcome.ok for outcome in here.call_sequence(calls, go_on=True)] == [True, False, True]
    assert lamp.level == 2


def test_the_same_from_asyncio(here: Container, offer: Callable[..., Any]) -> None:
    lamp = Lamp()
    handle = offer(lamp)("set_level")
    calls = [handle.bind(1), handle.bind(10), handle.bind(2)]

    async def main() -> None:
        assert await here.acall(where(name="set_level"), 5) == 5
        assert [outcome.ok for outcome in await here.acall_all(calls)] == [True, False, True]
        assert [outcome.ok for outcome in await here.acall_sequence(calls)] == [True, False]
        assert [outcome.ok for outcome in await here.acall_sequence(calls, go_on=True)] == [True, False, True]
        assert not (await here.acall_all(where(name="leave")))[0].ok
        assert await calls[0].acall() == 1

    asyncio.run(main())


def test_a_bound_call_is_a_value(here: Container) -> None:
    set_level = here.register(Lamp(), "hall")[0]
    call = set_level.bind(3, fast=True)
    assert isinstance(call, BoundCall)
    assert call == set_level.bind(3, fast=True)
    assert call != set_level.bind(3)
    assert len({call, set_level.bind(3, fast=True)}) == 1
    assert repr(call) == "<Bound hall.set_level(3, fast=True) in here>"
    with pytest.raises(TypeError, match="unhashable"):
        hash(set_level.bind([3]))
    assert set_level.bind(3)() == set_level.bind(4).start().result() - 1


def test_the_functions_of_the_module_do_the_same(monkeypatch: pytest.MonkeyPatch, here: Container) -> None:
    monkeypatch.setattr("trade._container.default._default", here)
    [handle] = [handle for handle in trade.register(Lamp(), "hall") if handle.name == "set_level"]
    assert trade.call(where(name="set_level"), 1) == 1
    assert [outcome.result for outcome in trade.call_all([handle], 2)] == [2]
    assert [outcome.result for outcome in trade.call_sequence([handle.bind(3)])] == [3]

    async def main() -> None:
        assert await trade.acall(where(name="set_level"), 1) == 1
        assert (await trade.acall_all([handle], 1))[0].ok
        assert (await trade.acall_sequence([handle.bind(1)]))[0].ok

    asyncio.run(main())
