"""What the command line takes as text, Python takes as text."""

import asyncio
import inspect
from collections.abc import Callable
from importlib import metadata
from typing import Any

import pytest

import trade
from tests.support.waiting import wait_until
from trade import Container, Handle, service, where
from trade.errors import ConfigurationError, LockLost, NoSuchService, TooManyServices
from trade.testing import memory_system

pytestmark = pytest.mark.virtual_time


class Joint:
    def __init__(self) -> None:
        self.moved: list[float] = []

    @service(cancel="stop")
    def move_to(self, position_rad: float) -> None:
        self.moved.append(position_rad)

    @service(effect="stop")
    def stop(self) -> None: ...

    @service(effect="read")
    def state(self) -> int:
        return len(self.moved)

    def save_state(self) -> list[float]:
        return self.moved

    def restore_state(self, state: list[float]) -> None:
        self.moved = state


class Listener:
    def __init__(self) -> None:
        self.heard: list[Any] = []

    @service(effect="note")
    def hear(self, called: Any) -> None:
        self.heard.append(called)


@pytest.fixture
def me() -> Container:  # type: ignore[misc]
    with memory_system() as system:
        yield system.container("me")  # type: ignore[misc]


@pytest.fixture
def pan(me: Container) -> Joint:
    joint = Joint()
    me.register(joint, "rosie.neck.pan")
    return joint


@pytest.fixture
def tilt(me: Container) -> Joint:
    joint = Joint()
    me.register(joint, "rosie.neck.tilt")
    return joint


def test_a_service_is_found_by_its_group_and_name(me: Container, pan: Joint, tilt: Joint) -> None:
    me.find("rosie.neck.pan.move_to")(0.3)
    me.call("rosie.neck.pan.move_to", 0.4)
    assert (pan.moved, tilt.moved) == ([0.3, 0.4], [])


def test_a_service_of_a_group_beneath_is_found_if_it_is_the_only_one(me: Container, pan: Joint) -> None:
    me.find("rosie.move_to")(0.3)
    me.find("move_to")(0.4)
    assert pan.moved == [0.3, 0.4]


def test_a_service_of_exactly_that_group_comes_before_those_beneath(me: Container, pan: Joint, tilt: Joint) -> None:
    whole = Joint()
    me.register(whole, "rosie.neck")
    me.find("rosie.neck.move_to")(0.3)
    assert (whole.moved, pan.moved, tilt.moved) == ([0.3], [], [])
    with pytest.raises(TooManyServices):
        me.find("rosie.move_to")
    with pytest.raises(TooManyServices):  # a constraint means what it says
        me.find(where(group="rosie.neck", name="move_to"))


def test_a_misspelt_service_is_an_error_that_suggests_the_right_one(me: Container, pan: Joint) -> None:
    with pytest.raises(NoSuchService, match=r"Did you mean rosie\.neck\.pan\.move_to\?"):
        me.find("rosie.neck.pan.moveto", wait_s=0)


def test_services_of_a_group_or_of_one_path_are_listed(me: Container, pan: Joint, tilt: Joint) -> None:
    assert {one.label for one in me.services("rosie.neck.pan")} == {
        "rosie.neck.pan.move_to",
        "rosie.neck.pan.stop",
        "rosie.neck.pan.state",
    }
    assert [one.label for one in me.services("rosie.neck.tilt.state")] == ["rosie.neck.tilt.state"]
    assert [outcome.result for outcome in me.call_all("rosie.neck.state")] == [0, 0]


def test_a_group_is_locked_resumed_and_taken_away_by_its_text(me: Container, pan: Joint, tilt: Joint) -> None:
    with pytest.raises(LockLost), me.lock("rosie.neck") as held:
        assert {name for info in me.locks() for name in info.resources} == set(held.resources)
        assert len(held.resources) == 2
        assert me.break_lock("rosie.neck.pan", "a test")
    me.stop("rosie.neck")
    assert me.resume("rosie.neck") == []  # nothing had moved


def test_a_service_is_streamed_by_its_text(me: Container, pan: Joint) -> None:
    with me.stream("rosie.neck.pan.state", hz=100) as samples:
        assert next(iter(samples)).value == 0


def test_hooks_and_notifications_take_texts(me: Container, pan: Joint, tilt: Joint) -> None:
    listener = Listener()
    [hear] = me.register(listener, "log")
    me.after_service("rosie.neck.pan.move_to", hear)
    me.find("rosie.neck.pan.move_to")(0.1)
    me.find("rosie.neck.tilt.move_to")(0.2)
    wait_until(lambda: listener.heard)
    assert len(listener.heard) == 1
    joined: list[str] = []
    me.joined("rosie.neck.pan", lambda handle: joined.append(handle.label), existing=True)
    wait_until(lambda: len(joined) == 3)
    me.once("rosie.neck.pan.state", when="rosie.neck.tilt.state")


def test_a_state_is_saved_by_a_text(me: Container, pan: Joint) -> None:
    pan.moved = [0.7]
    assert me.save_state("rosie.neck.pan") == [0.7]
    me.restore_state("rosie.neck.pan", [0.8])
    assert pan.moved == [0.8]


ENTRIES: dict[str, Callable[[Container, Any], Any]] = {
    "find": lambda me, which: me.find(which, wait_s=0),
    "call": lambda me, which: me.call(which),
    "services": lambda me, which: me.services(which),
    "lock": lambda me, which: me.lock(which, wait_s=0).acquire(),
    "resume": lambda me, which: me.resume(which, wait_s=0),
    "request_release": lambda me, which: me.request_release(which, "test"),
    "break_lock": lambda me, which: me.break_lock(which, "test"),
    "stream": lambda me, which: me.stream(which),
    "joined": lambda me, which: me.joined(which, print),
    "left": lambda me, which: me.left(which, print),
    "changed": lambda me, which: me.changed(which, print),
    "before_service": lambda me, which: me.before_service(which, me.services("rosie")[0]),
    "after_service": lambda me, which: me.after_service(which, me.services("rosie")[0]),
    "migrate": lambda me, which: me.migrate(which, to="elsewhere"),
    "save_state": lambda me, which: me.save_state(which),
    "restore_state": lambda me, which: me.restore_state(which, 1),
    "robot": lambda me, which: me.robot(which, wait_s=0),
}


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("which", [7, None, b"rosie", "", "rosie..neck", ".", ["rosie"]], ids=repr)
def test_what_is_no_selection_is_refused_with_the_function_and_what_to_give(
    me: Container, pan: Joint, entry: str, which: Any
) -> None:
    if (entry, which) == ("services", None):
        assert me.services(which)  # all of them
        return
    with pytest.raises(ConfigurationError) as refused:
        ENTRIES[entry](me, which)
    assert refused.value.where.startswith("trade.")
    assert pan.moved == []


def test_a_handle_has_the_signature_and_the_docstring_of_its_service(me: Container, pan: Joint) -> None:
    move = me.find("rosie.neck.pan.move_to")
    assert str(inspect.signature(move)) == "(position_rad: 'float')"
    assert (move.__doc__ or "").startswith("move_to(position_rad: float) -> None")
    assert (Handle.__doc__ or "").startswith("One service of one epoch")


def test_the_module_shows_its_public_names_and_its_version() -> None:
    assert set(dir(trade)) == {*trade.__all__, "__version__"}
    assert trade.__version__ == metadata.version("trade-core")
    with pytest.raises(AttributeError, match="no attribute 'lck'"):
        _ = trade.lck  # type: ignore[attr-defined]


def test_the_functions_for_asyncio_leave_the_event_loop_free(me: Container, pan: Joint) -> None:
    async def behave() -> list[float]:
        ticks: list[float] = []

        async def tick() -> None:
            while True:
                ticks.append(0.0)
                await asyncio.sleep(0.001)

        ticking = asyncio.create_task(tick())
        with pytest.raises(NoSuchService):
            await me.afind("rosie.neck.pan.moveto", wait_s=0.2)
        ticking.cancel()
        assert len(ticks) > 10
        move = await me.afind("rosie.neck.pan.move_to")
        async with me.lock("rosie.neck"):
            assert len(await me.alocks()) == 1
            await move.acall(0.3)
        async with await me.astream("rosie.neck.pan.state", hz=100) as samples:
            assert (await samples.anext()).value == 1
        assert (await me.astop("rosie.neck")).complete
        assert await me.aresume("rosie.neck") == []
        report = await me.aestop("a test")
        assert [one.id for one in me.estops()] == [report.id]
        return pan.moved

    assert asyncio.run(behave()) == [0.3]
