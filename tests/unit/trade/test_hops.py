"""Calls that make calls in other containers, and very many at once."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest

from trade import Container, Handle, current_call, service, where
from trade.errors import DeadlineExceeded

pytestmark = pytest.mark.virtual_time


class Relay:
    """Calls on, at once or when it is too late."""

    def __init__(self) -> None:
        self.outcome: Any = None
        self.done = threading.Event()
        self.may_return = threading.Event()

    @service
    def chain(self, on: list[Handle]) -> tuple[tuple[str, ...], float]:
        call = current_call()
        assert call is not None
        assert call.remaining_s is not None
        return on[0](on[1:]) if on else (call.chain, call.remaining_s)

    @service
    def late(self, then: Handle, middle: Handle | None = None) -> None:
        if middle is not None:
            middle(then)
            return
        call = current_call()
        assert call is not None
        while call.remaining_s:
            threading.Event().wait(0.01)
        try:
            then([])
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.outcome = error
        finally:
            self.done.set()
        assert self.may_return.wait(20)


class Counter:
    runs = 0

    @service
    def chain(self, on: list[Handle]) -> tuple[tuple[str, ...], float]:
        self.runs += 1
        return (), 0.0

    @service
    async def add(self, value: int) -> int:
        await asyncio.sleep(0)
        return value + 1


@pytest.fixture
def hops(here: Container, there: Container, start_container: Callable[..., Container]) -> dict[str, tuple[Relay, Any]]:
    """Three containers with a relay each, as seen from the first."""
    relays = {}
    for home in (here, there, start_container("beyond")):
        relay = Relay()
        home.register(relay, f"robot.{home.name}")
        relays[home.name] = (relay, lambda name, home=home: here.find(where(name=name, container=home.name), wait_s=20))
    return relays


def test_deadline_and_chain_go_over_two_hops(hops: Any) -> None:
    first, second = hops["there"][1]("chain"), hops["beyond"][1]("chain")
    chain, remaining_s = first.with_(deadline_s=5)([second, first])
    assert chain == ("robot.there.chain", "robot.beyond.chain")
    assert 0 < remaining_s <= 5


def test_S01_what_expired_two_hops_away_runs_nowhere(hops: Any, start_container: Callable[..., Container]) -> None:
    last = start_container("last")
    counter = Counter()
    last.register(counter, "last")
    relay, of_beyond = hops["beyond"]
    first = hops["there"][1]("late")
    chain = of_beyond("chain")
    then = hops["here"][1]("chain")._home.find(where(name="chain", container="last"), wait_s=20)
    assert chain([]) is not None
    then([])
    chain([then])
    ran = counter.runs
    with pytest.raises(TimeoutError):
        first.with_(deadline_s=1)(then, of_beyond("late"))
    assert relay.done.wait(20)
    relay.may_return.set()  # not before, as an answer could overtake the caller's own clock
    assert isinstance(relay.outcome, DeadlineExceeded)
    assert counter.runs == ran


def test_five_hundred_calls_at_once_from_asyncio(offer: Any) -> None:
    add = offer(Counter())("add").with_(deadline_s=60)

    async def all_of_them() -> list[int]:
        limit = asyncio.Semaphore(40)  # a container runs 63 at once and refuses what is more

        async def one(value: int) -> int:
            async with limit:
                return await add.acall(value)

        return await asyncio.gather(*(one(value) for value in range(500)))

    assert asyncio.run(all_of_them()) == list(range(1, 501))


def test_five_hundred_waiting_calls_of_a_serial_service(offer: Any) -> None:
    class Serial:
        @service(serial=True)
        def add(self, value: int) -> int:
            return value + 1

    add = offer(Serial())("add").with_(deadline_s=60)

    async def all_of_them() -> list[int]:
        return await asyncio.gather(*(add.acall(value) for value in range(500)))

    assert asyncio.run(all_of_them()) == list(range(1, 501))
