"""Locks of processes that are killed and frozen: the wire stays silent, and owners learn what became of them."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, Resource, permit, service, where
from trade.errors import LockLost

pytestmark = pytest.mark.slow


class Joint:
    def __init__(self, name: str) -> None:
        self.resource = Resource(name)
        self.resources = [self.resource]
        self.written: list[str] = []
        self.stopped = threading.Event()

    @service
    def write(self, text: str) -> None:
        with permit(self.resources) as permitted:
            permitted.gate()
            self.written.append(text)

    @service
    def go_on(self) -> None:
        with permit(self.resources) as permitted:
            permitted.gate()
            self.resource.moving = True

    @service(effect="stop")
    def stop(self) -> None:
        self.resource.moving = False
        self.stopped.set()


@pytest.fixture
def joints(there: Container) -> Iterator[dict[str, Joint]]:
    """Two of them, offered by the test's own process."""
    made = {name: Joint(name) for name in "ab"}
    for name, joint in made.items():
        there.register(joint, f"robot.{name}")
    yield made


OWNER = """
from trade.errors import LockLost
trade.find(where(name="write", group="robot.a"), wait_s=30)
trade.find(where(name="write", group="robot.b"), wait_s=30)
lock = trade.lock(where(group="robot"), lease_s=float(sys.argv[1])).acquire()
with lock.use():
    trade.find(where(name="go_on", group="robot.a"))()
    trade.find(where(name="write", group="robot.b"))("owner")
say("moving")
hear()
try:
    with lock.use():
        trade.find(where(name="write", group="robot.b"))("stale")
    say("written")
except LockLost:
    say("lost", lock.held)
"""


@pytest.mark.parametrize("end", ["kill", "freeze"])
def test_S14_when_an_owner_is_gone_what_it_moved_stops_and_others_get_it(
    start_program: Any, here: Container, joints: dict[str, Joint], end: str
) -> None:
    owner = start_program(OWNER, "30")
    assert owner.heard() == "moving"
    owner.kill() if end == "kill" else owner.freeze()
    assert joints["a"].stopped.wait(60)
    assert not joints["b"].stopped.is_set()  # it was at rest
    here.find(where(name="write", group="robot.b"), wait_s=30)
    with here.lock(where(group="robot"), wait_s=60):
        here.find(where(name="write", group="robot.b"))("next")
    assert joints["b"].written == ["owner", "next"]


def test_S12_an_owner_that_wakes_knows_its_lock_is_lost_before_it_does_anything(
    start_program: Any, here: Container, joints: dict[str, Joint]
) -> None:
    """Its lease is shorter than it takes to notice that it is frozen: only the lease ends the lock."""
    owner = start_program(OWNER, "1")
    assert owner.heard() == "moving"
    owner.freeze()
    here.find(where(name="write", group="robot.b"), wait_s=30)
    with here.lock(where(group="robot"), wait_s=60, lease_s=60):
        assert joints["a"].stopped.is_set()
        owner.thaw()
        owner.tell()
        assert owner.heard() == "lost False"
    assert joints["b"].written == ["owner"]


DRIVER = """
import threading
from trade import Resource, permit
class Joint:
    def __init__(self):
        self.resources = [Resource("far")]
    @service
    def write(self, text: str) -> None:
        with permit(self.resources) as permitted:
            say("entered")
            hear()
            try:
                permitted.gate()
                say("written", text)
            except trade.errors.TradeError:  # lost, or stopped since it was
                say("refused")
    @service(effect="stop")
    def stop(self) -> None:
        pass
trade.register(Joint(), "robot.far")
say("ready")
threading.Event().wait(60)
"""


def test_S12_a_driver_that_wakes_writes_nothing_under_a_lease_that_ended_meanwhile(
    start_program: Any, here: Container
) -> None:
    driver = start_program(DRIVER)
    assert driver.heard() == "ready"
    handle = here.find(where(name="write", group="robot.far"), wait_s=30).with_(deadline_s=3600)
    lock = here.lock([handle], lease_s=1).acquire()
    with lock.use():
        run = handle.start("stale")
    assert driver.heard() == "entered"
    driver.freeze()
    frozen_at = time.monotonic()
    wait_until(lambda: not lock.held and time.monotonic() > frozen_at + lock.lease_s)  # by the driver's clock, too
    driver.tell()
    driver.thaw()
    assert driver.heard() == "refused"
    run.exception(60)  # it is over, whether its end was heard or not


def test_S14_a_member_killed_loses_the_whole_lock_and_the_rest_stops(
    start_program: Any, here: Container, joints: dict[str, Joint]
) -> None:
    driver = start_program(DRIVER)
    assert driver.heard() == "ready"
    for name in ("robot.far", "robot.a"):
        here.find(where(name="write", group=name), wait_s=30)
    lost: list[LockLost] = []
    with pytest.raises(LockLost), here.lock(where(group="robot"), lease_s=60, on_lost=lost.append):
        here.find(where(name="go_on", group="robot.a"))()
        driver.kill()
        wait_until(lambda: lost)
        assert joints["a"].stopped.wait(60)
        here.find(where(name="write", group="robot.b"))("stale")
    assert joints["b"].written == []
    wait_until(lambda: here.locks() == [])
