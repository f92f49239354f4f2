"""What ends a call ends the calls that it makes: cancelling, its deadline, the end of who asked. The servos judge."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig, written_now
from trade import Container, Handle, Run, service, where
from trade.errors import Cancelled, MotionStopped, SessionEnded, TradeError
from trade_drivers import AttachedRobot, attach

pytestmark = pytest.mark.virtual_time

FAR, SLOW = 1.2, 0.1
"""12 s away."""
Begin = Callable[..., Run]
PAN = where(group="rosie.neck.pan")


class Mind:
    """Moves the pan of a robot in another container, and waits for it."""

    def __init__(self, container: Container) -> None:
        self._container = container
        self.failed: list[Exception] = []

    @property
    def _move(self) -> Handle:
        return self._container.find(PAN & where(name="move_to"), wait_s=20).with_(deadline_s=60)

    @service
    def look(self) -> float:
        return self._move(FAR, SLOW)

    @service
    async def look_async(self) -> float:
        return await self._move.acall(FAR, SLOW)

    @service
    def look_apart(self) -> None:
        run = self._move.start(FAR, SLOW)
        while not run.done():
            threading.Event().wait(0.01)

    @service
    def look_about(self) -> None:
        """Continues to the next place, whatever became of the one before."""
        for goal in (FAR, -FAR, FAR):
            try:
                self._move(goal, SLOW)
            except TradeError as error:
                self.failed.append(error)

    @service
    def think(self, thought: str) -> None:
        """One more container in between."""
        self._container.find(where(group="deep", name=thought), wait_s=20).with_(deadline_s=60)()


@pytest.fixture
def robot(head: Rig, start_container: Callable[..., Container]) -> Iterator[AttachedRobot]:
    driver = start_container("driver")
    ports = {"neck": str(head.sim.port)}
    with attach(head.robot, driver, ports=ports) as up:
        yield up


@pytest.fixture(params=["one", "two"])
def mind(request: pytest.FixtureRequest, robot: AttachedRobot, start_container: Callable[..., Container]) -> Mind:
    """In a container of its own, which calls the robot by itself or has another one do so."""
    deep = start_container("deep")
    mind = Mind(deep)
    deep.register(mind, "deep")
    if request.param == "two":
        between = start_container("between")
        between.register(Mind(between), "between")
    return mind


def asked(request: pytest.FixtureRequest, name: str) -> list[str]:
    """How a person asks for a service of the mind: group, name, arguments."""
    return ["deep", name] if request.node.callspec.params["mind"] == "one" else ["between", "think", name]


@pytest.fixture
def begin(mind: Mind, start_container: Callable[..., Container], request: pytest.FixtureRequest) -> Begin:
    """A person who asks for a service of the mind."""
    person = start_container("person")

    def begin(name: str, deadline_s: float = 60) -> Run:
        group, name, *args = asked(request, name)
        return person.find(where(group=group, name=name), wait_s=20).with_(deadline_s=deadline_s).start(*args)

    return begin


@contextmanager
def holds(head: Rig) -> Iterator[None]:
    """What happens inside has the pan hold where it is, within its braking, and nothing moves it afterwards."""
    began = head.wait_for("motion_started", 1)
    wait_until(lambda: head.truth(1).position_rad > 0.02, "it is under way")
    yield
    over = written_now()
    head.wait_for("at_rest", 1, began.t)
    assert head.truth(1).position_rad < FAR / 2
    wait_until(lambda: written_now() > over + 0.5, "some time has passed")
    assert not head.truth(1).moving
    assert not head.events("motion_started", 1, over)


def test_a_caller_elsewhere_learns_why_its_motion_ended_before_its_deadline(
    head: Rig, robot: AttachedRobot, start_container: Callable[..., Container]
) -> None:
    move = start_container("person").find(PAN & where(name="move_to"), wait_s=20)
    run = move.with_(deadline_s=1.0).start(FAR, SLOW)
    with holds(head):
        wait_until(run.done, "it has ended")
    with pytest.raises(MotionStopped, match="deadline"):
        run.result()


@pytest.mark.parametrize("how", ["look", "look_async", "look_apart", "look_about"])
def test_S05_a_cancelled_call_ends_what_the_service_moves_elsewhere(
    head: Rig, mind: Mind, begin: Begin, how: str
) -> None:
    run = begin(how)
    with holds(head):
        run.cancel()
        wait_until(run.done, "it has ended")
    if how == "look_about":
        stopped, *refused = mind.failed
        assert isinstance(stopped, MotionStopped)
        assert [type(error) for error in refused] == [Cancelled, Cancelled]


@pytest.mark.parametrize("how", ["look", "look_async", "look_apart", "look_about"])
def test_S05_the_deadline_of_a_call_ends_what_the_service_moves_elsewhere(head: Rig, begin: Begin, how: str) -> None:
    run = begin(how, deadline_s=1.5)
    with holds(head):
        wait_until(run.done, "it has ended")


CALLER = """
import sys
from trade import Container, Settings, where
with Container(Settings.read(system=sys.argv[1], container="caller")) as caller:
    group, name, *args = sys.argv[2:]
    found = caller.find(where(group=group, name=name), wait_s=20)
    found.with_(deadline_s=60)(*args)
"""


@pytest.mark.realtime
@pytest.mark.parametrize("how", ["look", "look_async", "look_apart", "look_about"])
def test_S05_the_death_of_the_caller_ends_what_the_service_moves_elsewhere(
    head: Rig, mind: Mind, system: str, how: str, request: pytest.FixtureRequest
) -> None:
    with subprocess.Popen([sys.executable, "-c", CALLER, system, *asked(request, how)]) as caller:
        try:
            with holds(head):
                caller.kill()
        finally:
            caller.kill()
    if how == "look_about":
        wait_until(lambda: len(mind.failed) == 3, "it has ended")
        assert {type(error) for error in mind.failed[1:]} <= {Cancelled, SessionEnded}
