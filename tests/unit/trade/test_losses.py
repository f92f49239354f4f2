"""A container that is killed, frozen, restarted: callers learn of it and go on."""

import asyncio
from typing import Any

import pytest

from trade import Container, Handle, service, where
from trade.errors import ContainerLost, ServiceGone

DRIVER = """
import threading
class Driver:
    @service
    def hang(self) -> None:
        say("inside")
        threading.Event().wait(60)
    @service(effect="read")
    def pid(self) -> int:
        import os
        return os.getpid()
driver = Container(Settings.read(container="driver"))
driver.register(Driver(), "robot")
say("ready")
hear()
import os
os._exit(0)
"""


def found(here: Container, name: str) -> Handle:
    return here.find(where(name=name, group="robot"), wait_s=20)


@pytest.fixture
def driver(start_program: Any) -> Any:
    program = start_program(DRIVER)
    program.heard()
    return program


@pytest.mark.slow
def test_a_call_in_flight_ends_when_its_callee_is_killed(here: Container, driver: Any) -> None:
    hang = found(here, "hang").with_(deadline_s=3600)
    runs = [hang.start() for _ in range(3)]
    assert [driver.heard() for _ in range(3)] == ["inside"] * 3
    driver.kill()
    for run in runs:
        with pytest.raises(ContainerLost, match=r"container driver was lost during a call of robot.hang. Whether it"):
            run.result()


@pytest.mark.slow
def test_a_blocked_caller_is_freed_when_its_callee_is_killed(here: Container, driver: Any, eventually: Any) -> None:
    import threading

    hang = found(here, "hang").with_(deadline_s=3600)

    def kill_it_once_inside() -> None:
        driver.heard()
        driver.kill()

    killer = threading.Thread(target=kill_it_once_inside)
    killer.start()
    with pytest.raises(ConnectionError):
        hang()
    killer.join()


@pytest.mark.slow
def test_an_asyncio_caller_is_freed_when_its_callee_is_killed(here: Container, driver: Any) -> None:
    hang = found(here, "hang").with_(deadline_s=3600)

    async def lose_it() -> None:
        run = hang.start()
        await asyncio.to_thread(driver.heard)
        driver.kill()
        await run

    with pytest.raises(ContainerLost):
        asyncio.run(lose_it())


@pytest.mark.slow
def test_after_its_container_was_killed_a_service_is_gone(here: Container, driver: Any) -> None:
    hang = found(here, "hang")
    run = hang.start()
    driver.heard()
    driver.kill()
    run.exception()
    with pytest.raises(ServiceGone, match="container driver has ended, restarted or cannot be reached"):
        hang()
    with pytest.raises(ServiceGone):
        hang.start().result()


@pytest.mark.slow
def test_a_restarted_callee_is_found_again_without_restarting_the_caller(
    here: Container, driver: Any, start_program: Any
) -> None:
    first = found(here, "pid")
    assert first() == driver.process.pid
    driver.kill()
    again = start_program(DRIVER)
    again.heard()
    assert here._parts.registry.wait_for(lambda: not first.alive, 20)
    second = found(here, "pid")
    assert second != first
    assert second() == again.process.pid
    with pytest.raises(ServiceGone):
        first()


@pytest.mark.slow
def test_a_frozen_callee_is_lost_after_its_lease_and_back_when_it_wakes(here: Container, driver: Any) -> None:
    pid = found(here, "pid")
    run = found(here, "hang").with_(deadline_s=3600).start()
    driver.heard()
    driver.freeze()
    assert isinstance(run.exception(), ContainerLost)
    assert here._parts.registry.wait_for(lambda: not pid.alive, 20)
    with pytest.raises(ServiceGone):
        pid()
    driver.thaw()
    assert here._parts.registry.wait_for(lambda: pid.alive, 20)
    assert pid() == driver.process.pid
    assert found(here, "pid") == pid


@pytest.mark.slow
def test_what_is_known_of_a_clock_is_void_once_its_container_was_out_of_sight(here: Container, driver: Any) -> None:
    """A computer that sleeps stops its clock: an expiry reckoned by the old offset would be too late."""
    hang = found(here, "hang")
    assert found(here, "pid")() == driver.process.pid
    caller, address = here._parts.caller, hang.key.address
    assert caller.peer(address).clock_known
    caller.lost(address)
    assert caller.peer(address).expiry_ns(10**12) is None
    caller.lost(address, back=True)
    assert not caller.peer(address).clock_known
    here._parts.targets.known.clear()
    assert found(here, "pid")() == driver.process.pid
    assert caller.peer(address).clock_known


@pytest.mark.slow
def test_the_death_of_one_container_leaves_calls_to_others_alone(
    here: Container, there: Container, driver: Any, gate: Any
) -> None:
    there.register(gate, "gate")
    inside = here.find(where(name="pass_through"), wait_s=20).start()
    run = found(here, "hang").start()
    driver.heard()
    driver.kill()
    assert isinstance(run.exception(), ContainerLost)
    gate.open.set()
    assert inside.result(20) == "through"


def test_a_container_that_closes_ends_the_calls_it_runs(here: Container, there: Container, gate: Any) -> None:
    there.register(gate, "robot")
    run = here.find(where(name="pass_through"), wait_s=20).with_(deadline_s=3600).start()
    gate.entered.wait(20)
    import threading

    closing = threading.Thread(target=there.close)
    closing.start()
    assert isinstance(run.exception(), ContainerLost)
    gate.open.set()
    closing.join()


@pytest.mark.slow
def test_a_callee_does_not_notice_that_its_caller_died(here: Container, start_program: Any, gate: Any) -> None:
    here.register(gate, "robot")

    class Echo:
        @service(effect="read")
        def echo(self, value: int) -> int:
            return value

    here.register(Echo(), "robot")
    caller = start_program(
        """
        handle = trade.find(where(name="pass_through"), wait_s=20)
        handle.start()
        say("called")
        hear()
        """
    )
    caller.heard()
    gate.entered.wait(20)
    caller.kill()
    gate.open.set()
    other = start_program('say(trade.find(where(name="echo"), wait_s=20)(5))')
    assert other.heard() == "5"
