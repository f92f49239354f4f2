"""Functions as services, and scripts that serve until they are ended."""

import os
import signal
import threading

import pytest

import trade
from tests.conftest import StartContainer
from tests.support.waiting import wait_until
from tests.unit.trade.conftest import StartProgram
from trade import Container, service, where
from trade.errors import ConfigurationError, InvalidArgument, NoSuchService
from trade.testing import memory_system

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def me() -> Container:  # type: ignore[misc]
    with memory_system() as system:
        yield system.container("me")  # type: ignore[misc]


def test_a_function_is_a_service(me: Container) -> None:
    @service(effect="read")
    def add(one: float, other: float = 1.0) -> float:
        """Adds two numbers."""
        return one + other

    [handle] = me.register(add, "sums", meta={"cheap": True})
    assert handle(2.0) == 3.0
    assert (handle.signature, handle.doc) == ("add(one: float, other: float = 1.0) -> float", "Adds two numbers.")
    assert (handle.label, handle.kinds, handle.meta) == ("sums.add", ("add",), {"cheap": True})
    assert add(2.0, 2.0) == 4.0
    with pytest.raises(InvalidArgument):
        handle("two")


def test_a_function_is_regrouped_and_deregistered_like_an_object(me: Container) -> None:
    @service
    def wave() -> None: ...

    me.register(wave, "sums")
    me.set_groups(wave, "manners")
    assert me.find("manners.wave", wait_s=0)() is None
    with pytest.raises(ConfigurationError, match="registered"):
        me.register(wave)
    me.deregister(wave)
    with pytest.raises(NoSuchService):
        me.find("manners.wave", wait_s=0)
    me.register(wave, "manners")
    assert me.find("manners.wave", wait_s=0)() is None


def test_an_asynchronous_function_is_a_service_too(me: Container) -> None:
    @service
    async def wave(times: int) -> int:
        return times

    me.register(wave)
    assert me.call(where(name="wave"), 3) == 3


def test_a_function_without_the_mark_is_refused(me: Container) -> None:
    def add(one: float) -> float:
        return one

    with pytest.raises(ConfigurationError, match=r"add: it is no service; mark it with @trade\.service"):
        me.register(add)


SCRIPT = """
@service
def add(one: float, other: float) -> float:
    return one + other
trade.register(add, groups="sums")
say("ready", os.getpid())
trade.serve()
say("left", trade.container.__module__)
"""


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_script_serves_until_it_is_ended(
    system: str, start_program: StartProgram, start_container: StartContainer, number: signal.Signals
) -> None:
    script = start_program(SCRIPT)
    ready, pid = script.heard().split()
    assert ready == "ready"
    me = start_container("me")
    assert me.find("sums.add", wait_s=20)(1.0, 2.0) == 3.0
    os.kill(int(pid), number)
    assert script.heard().startswith("left")
    assert script.process.wait(20) == 0
    wait_until(lambda: not me.services("sums"))


def test_serving_ends_when_the_container_is_closed_elsewhere(system: str) -> None:
    running = trade.container()
    serving = threading.Thread(target=trade.serve)
    serving.start()
    running.close()
    serving.join(20)
    assert not serving.is_alive()
