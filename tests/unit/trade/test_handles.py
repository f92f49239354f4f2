"""Handles: values that name one service of one boot, callable from anywhere."""

import asyncio
import copy
import pickle
from typing import Any

import pytest

from trade import Container, Handle, current_call, service, where
from trade._registry import registry
from trade.errors import ConfigurationError, ServiceGone
from trade.protocol.keys import ServiceKey

pytestmark = pytest.mark.virtual_time


class Counter:
    def __init__(self) -> None:
        self.count = 0

    @service
    def add(self, step: int = 1) -> int:
        self.count += step
        return self.count

    @service(effect="read")
    def value(self) -> int:
        return self.count


class Courier:
    """Passes handles on."""

    kept: Handle | None = None

    @service
    def keep(self, handle: Handle) -> None:
        self.kept = handle

    @service
    def give(self) -> Handle | None:
        return self.kept

    @service
    def many(self, handles: list[Handle]) -> dict[str, Handle]:
        return {handle.name: handle for handle in handles}

    @service
    def use(self, handle: Handle) -> Any:
        return handle()


def found(container: Container, name: str, **more: Any) -> Handle:
    return container.find(where(name=name, **more), wait_s=20)


def test_a_handle_is_called_like_a_function(offer: Any) -> None:
    assert offer(Counter())("add")(2) == 2


def test_a_started_call_is_waited_for_later(offer: Any) -> None:
    run = offer(Counter())("add").start(2)
    assert (run.result(20), run.done(), run.exception(0)) == (2, True, None)


def test_a_started_call_raises_its_error_when_asked(offer: Any) -> None:
    class Failing:
        @service
        def fail(self) -> None:
            raise KeyError("pan")

    run = offer(Failing())("fail").start()
    assert isinstance(run.exception(20), KeyError)
    with pytest.raises(KeyError, match="pan"):
        run.result()


def test_waiting_for_a_started_call_may_be_given_up_without_ending_it(offer: Any, gate: Any) -> None:
    run = offer(gate)("pass_through").start()
    gate.entered.wait(20)
    with pytest.raises(TimeoutError, match="has not ended after 0 s; it continues"):
        run.result(0)
    gate.open.set()
    assert run.result(20) == "through"


@pytest.mark.real_clock
def test_a_started_call_is_cancelled_by_the_service_named_for_that(offer: Any) -> None:
    import threading

    class Walker:
        def __init__(self) -> None:
            self.begun, self.stopped = threading.Event(), threading.Event()

        @service(cancel="halt")
        def walk(self) -> str:
            self.begun.set()
            self.stopped.wait(20)
            return "stopped early"

        @service(effect="stop")
        def halt(self) -> None:
            self.stopped.set()

    walker = Walker()
    run = offer(walker)("walk").start()
    assert walker.begun.wait(20)
    run.cancel()
    assert run.result(20) == "stopped early"


def test_a_call_that_has_ended_is_not_cancelled_any_more(offer: Any) -> None:
    add = offer(Counter())("add")
    run = add.start()
    run.result(20)
    run.cancel()
    with pytest.raises(ConfigurationError, match=r"robot.add: it cannot be cancelled"):
        add.cancel_service()


def test_many_calls_run_at_once_from_asyncio(offer: Any) -> None:
    add = offer(Counter())("add")

    async def all_at_once() -> list[int]:
        return await asyncio.gather(*(add.acall(0) for _ in range(50)))

    assert asyncio.run(all_at_once()) == [0] * 50


def test_an_asyncio_call_raises_the_services_error(offer: Any) -> None:
    add = offer(Counter())("add")
    with pytest.raises(ValueError, match="Expected `int`, got `str`"):
        asyncio.run(add.acall("x"))


def test_a_started_call_may_be_awaited(offer: Any) -> None:
    add = offer(Counter())("add")

    async def later() -> int:
        run = add.start(3)
        return await run

    assert asyncio.run(later()) == 3


def test_options_make_another_handle_of_the_same_service(offer: Any) -> None:
    add = offer(Counter())("add")
    assert add.with_(deadline_s=3)(1) == 1
    assert add.with_(deadline_s=3) == add


def test_the_deadline_reaches_the_service(offer: Any) -> None:
    class Clock:
        @service
        def left(self) -> float:
            call = current_call()
            assert call is not None
            assert call.remaining_s is not None
            return call.remaining_s

    left = offer(Clock())("left")
    assert 100 < left.with_(deadline_s=1000)() <= 1000
    assert left() <= 10


@pytest.mark.parametrize("deadline_s", [0, -1, float("nan"), float("inf"), 1e300])
def test_a_deadline_must_be_a_time_one_can_wait_for(here: Container, deadline_s: float) -> None:
    (add, _) = here.register(Counter())
    with pytest.raises(ConfigurationError, match="deadline_s must be more than 0 and at most 86400"):
        add.with_(deadline_s=deadline_s)


def test_handles_of_one_service_are_equal_wherever_they_were_found(here: Container, there: Container) -> None:
    (own, _) = there.register(Counter())
    seen = found(here, "add")
    assert seen == own
    assert hash(seen) == hash(own)
    assert {seen: "found"}[own] == "found"


def test_handles_of_different_services_differ(here: Container) -> None:
    add, value = here.register(Counter(), "a")
    other, _ = here.register(Counter(), "b")
    assert len({add, value, other}) == 3
    assert add != "add"


def test_a_handle_shows_the_name_groups_and_container_of_its_service(here: Container, there: Container) -> None:
    there.register(Counter(), ["rosie.head", "lab"])
    seen = found(here, "add")
    reported = (seen.name, seen.label, seen.groups, seen.container, seen.local, seen.alive, seen.roles)
    assert reported == ("add", "rosie.head.add", ("rosie.head", "lab"), "there", False, True, ())
    assert repr(seen) == "<Handle rosie.head.add in there>"


def test_a_handle_passes_as_an_argument(offer: Any, here: Container) -> None:
    courier = Courier()
    keep = offer(courier)("keep")
    (add, _) = here.register(Counter(), "mine")
    keep(add)
    assert courier.kept == add
    assert courier.kept is not None
    assert courier.kept(4) == 4


def test_a_handle_passes_as_a_result(offer: Any, here: Container) -> None:
    (add, _) = here.register(Counter(), "mine")
    courier = Courier()
    give = offer(courier)("give")
    assert give() is None
    courier.kept = add
    assert give() == add
    assert give()(2) == 2


def test_handles_pass_inside_other_values(offer: Any, here: Container) -> None:
    handles = here.register(Counter(), "mine")
    assert offer(Courier())("many")(list(handles)) == {"add": handles[0], "value": handles[1]}


def test_a_handle_reaches_a_third_container_and_works_there(start_container: Any, here: Container) -> None:
    owner, third = start_container("owner"), start_container("third")
    owner.register(Counter(), "counted")
    third.register(Courier(), "third")
    assert found(here, "use")(found(here, "value", group="counted")) == 0


def test_a_handle_works_before_its_registry_entry_came(
    here: Container, there: Container, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message that carries a handle may overtake the registry entry: the call waits for it."""
    import threading

    class Late:
        @service
        def hello(self) -> str:
            return "hello"

    key = ServiceKey(there.address, "late", "Late-1", "hello")  # its first provider, which is still to come
    early = here.handle(key)
    assert early.last_record is None
    monkeypatch.setattr(registry, "_KNOWN_WITHIN_S", 20.0)  # on a busy computer it comes late
    coming = threading.Timer(0.05, lambda: there.register(Late(), "late"))
    coming.start()
    assert early() == "hello"
    coming.join()


def test_a_handle_of_nothing_is_refused(here: Container) -> None:
    nowhere = here.handle(ServiceKey(here.address, "x", "Nothing-9", "go"))
    with pytest.raises(ServiceGone, match=r"x.go is gone: it is not known here. Look it up again"):
        nowhere()


def test_a_handle_is_dead_after_its_provider_was_deregistered(here: Container) -> None:
    counter = Counter()
    (add, _) = here.register(counter, "a")
    assert add() == 1
    here.deregister(counter)
    with pytest.raises(ServiceGone, match=r"a.add is gone: its provider was deregistered. Look it up again"):
        add()
    assert (add.alive, counter.count) == (False, 1)


def test_a_remote_handle_is_dead_after_its_provider_was_deregistered(here: Container, there: Container) -> None:
    counter = Counter()
    there.register(counter, "a")
    add = found(here, "add")
    assert add() == 1
    there.deregister(counter)  # whether or not the word has reached us yet: the call is refused
    with pytest.raises(ServiceGone):
        add()
    assert counter.count == 1


def test_a_handle_is_dead_after_its_container_closed(here: Container, there: Container) -> None:
    there.register(Counter(), "a")
    add = found(here, "add")
    assert add() == 1
    there.close()
    with pytest.raises((ServiceGone, ConnectionError)):
        add()
    here._parts.registry.wait_for(lambda: not add.alive, 20)
    with pytest.raises(ServiceGone, match="container there has ended, restarted or cannot be reached"):
        add()


def test_a_handle_of_an_earlier_boot_never_reaches_the_next_one(start_container: Any, here: Container) -> None:
    old = start_container("robot")
    old.register(Counter(), "a")
    stale = found(here, "add")
    old.close()
    new = start_container("robot")
    fresh_counter = Counter()
    new.register(fresh_counter, "a")
    here._parts.registry.wait_for(lambda: not stale.alive, 20)
    with pytest.raises(ServiceGone):
        stale()
    fresh = found(here, "add")
    assert fresh != stale
    assert (fresh(), fresh_counter.count) == (1, 1)


def test_a_dead_handle_keeps_its_signature_groups_and_effect(here: Container) -> None:
    counter = Counter()
    (add, _) = here.register(counter, "a")
    here.deregister(counter)
    assert (add.signature, add.groups, add.effect) == ("add(step: int = 1) -> int", ("a",), "actuate")


def test_the_call_chain_lists_the_calling_services(offer: Any, here: Container) -> None:
    class Inner:
        @service
        def chain(self) -> list[str]:
            call = current_call()
            assert call is not None
            return [*call.chain, call.service]

    class Outer:
        @service
        def ask(self, inner: Handle) -> list[str]:
            return inner()

    (inner,) = here.register(Inner(), "inner")
    assert offer(Outer())("ask")(inner) == ["robot.ask", "inner.chain"]


def test_every_call_has_an_id_of_its_own(offer: Any) -> None:
    class Ids:
        @service
        def own(self) -> int:
            call = current_call()
            assert call is not None
            return call.id

    own = offer(Ids())("own")
    assert len({own() for _ in range(10)} - {0}) == 10


def test_outside_of_a_call_there_is_no_call() -> None:
    assert current_call() is None


def test_a_handle_cannot_be_pickled_and_says_what_to_do_instead(here: Container) -> None:
    handle = here.services()[0]
    for value in (handle, [handle], handle.bind(1)):
        with pytest.raises(TypeError, match=r"Give it to the other process as an argument .* or look the service up"):
            pickle.dumps(value)


def test_a_copy_of_a_handle_is_the_handle(here: Container) -> None:
    handle = here.services()[0]
    assert copy.copy(handle) is handle
    assert copy.deepcopy({"handle": handle})["handle"] is handle


def test_a_failing_done_callback_does_not_block_the_other_callbacks(
    here: Container, caplog: pytest.LogCaptureFixture
) -> None:
    [add] = [handle for handle in here.register(Counter(), "counted") if handle.name == "add"]
    run = add.start(5)
    assert run.result(20) == 5
    reported: list[int] = []
    run.add_done_callback(lambda _: reported.append(1 // 0))
    run.add_done_callback(lambda ended: reported.append(ended.result()))
    assert reported == [5]
    assert "a callback at the end of" in caplog.text
