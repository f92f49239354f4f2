"""Two systems that share some services (P69): what crosses is called, locked, moved and stopped as at home."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from msgspec import Struct

from tests.support.two_joint_robot import Joint
from tests.support.two_systems import member
from tests.support.waiting import wait_until
from trade import Container, Handle, errors, progress, service, where
from trade._context.sessions import foreign
from trade.sharing import Border
from trade.testing import MemorySystem, memory_system

pytestmark = pytest.mark.virtual_time


class Point(Struct):
    x: float
    y: float


class Odd(Exception):
    """An error that no other program would know."""


class Brain:
    """Software: what needs no hardware."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, tuple[str, ...], tuple[str, ...], float]] = []
        self.entered = threading.Event()
        self.cancelled = threading.Event()

    @service(effect="read")
    def middle(self, one: Point, other: Point) -> Point:
        """Half way."""
        return Point((one.x + other.x) / 2, (one.y + other.y) / 2)

    @service
    def who(self, *, note: str = "") -> str:
        from trade import current_call

        call = current_call()
        assert call is not None
        self.seen.append((call.caller, call.sessions, call.chain, call.remaining_s or 0.0))
        return note

    @service(effect="read")
    def fail(self, how: str) -> None:
        if how == "limit":
            raise errors.LimitExceeded(what="pan", value=2.0, lower=0.0, upper=1.0, unit="rad")
        raise Odd(how)

    @service
    def long(self) -> None:
        from trade import current_call

        call = current_call()
        assert call is not None
        progress("half way")
        self.entered.set()
        if call.wait_cancelled(30):
            self.cancelled.set()
            call.raise_if_cancelled()

    @service(effect="read")
    def apply(self, which: Handle, value: float) -> float:
        return which(value)

    @service(effect="read")
    def picture(self, size: int) -> bytes:
        return bytes(size)

    @service(effect="read")
    def itself(self) -> Handle:
        return self.home

    home: Handle


@dataclass
class Two:
    """System ``memory`` with a robot, system ``clinic`` with people, and a border between them."""

    lab: MemorySystem
    clinic: MemorySystem
    joint: Joint
    brain: Brain
    robot: Container
    planner: Container
    anna: Container
    bob: Container
    ours: Container
    theirs: Container
    border: Border

    def settle(self) -> None:
        for system in (self.lab, self.clinic):
            system.settle()

    def find(self, name: str, who: Container | None = None) -> Handle:
        return (who or self.anna).find(where(name=name) & ~where(group="trade"), wait_s=20)


@pytest.fixture
def two() -> Iterator[Two]:
    with memory_system() as lab, memory_system() as clinic:
        robot, planner = lab.container("robot", identity="rosie"), lab.container("planner", identity="planner")
        joint, brain = Joint("pan"), Brain()
        robot.register(joint, "rosie.head")
        brain.home = next(one for one in robot.register(brain, "rosie.mind") if one.name == "middle")
        robot.register(Joint("cellar"), "cellar")
        anna = member(clinic, "anna", "clinic", "anna")
        bob = member(clinic, "bob", "clinic", "bob")
        ours, theirs = lab.container("door", identity="door"), member(clinic, "door", "clinic", "guest")
        for system in (lab, clinic):
            system.settle()
        border = Border(ours, theirs, exported=["rosie"])
        made = Two(lab, clinic, joint, brain, robot, planner, anna, bob, ours, theirs, border)
        made.settle()
        yield made
        border.close()


def test_what_is_exported_is_found_as_it_is_at_home_and_nothing_else_is(two: Two) -> None:
    labels = {handle.label for handle in two.anna.services(~where(group="trade"))}
    assert labels == {handle.label for handle in two.planner.services(where(group="rosie"))}
    here = two.find("move")
    [home] = two.planner.services(where(name="move", group="rosie"))
    assert (here.schema, here.doc, here.effect, here.resources) == (home.schema, home.doc, home.effect, home.resources)
    assert here.meta == {"shared_from": "memory"}


def test_calls_give_results_and_errors_of_their_own_types(two: Two) -> None:
    assert two.find("middle")(Point(0, 0), Point(2, 4)) == Point(1, 2)
    assert two.find("middle")(one=Point(0, 0), other=Point(2, 4)) == Point(1, 2)
    with pytest.raises(errors.LimitExceeded, match="pan") as beyond:
        two.find("fail")("limit")
    assert beyond.value.upper == 1.0
    with pytest.raises(Odd, match="odd"):
        two.find("fail")("odd")
    with pytest.raises(errors.InvalidArgument, match="other"):
        two.find("middle")(Point(0, 0), 3)


def test_large_results_cross(two: Two) -> None:
    assert len(two.anna.find(where(name="picture"))(300_000)) == 300_000


def test_deadline_lineage_and_who_it_is_for_go_along(two: Two) -> None:
    with two.anna.open_session("page"):
        two.find("who").with_(deadline_s=5)(note="x")
    [(caller, sessions, chain, left_s)] = two.brain.seen
    assert caller == "door"
    assert foreign(sessions[0]) == "clinic/anna via door"
    assert chain == ("rosie.mind.who",)
    assert 0 < left_s <= 5


def test_progress_comes_back_and_cancelling_goes_there(two: Two) -> None:
    run = two.find("long").start()
    wait_until(lambda: run.progress() == "half way", "progress crosses")
    run.cancel()
    with pytest.raises(errors.Cancelled):
        run.result(20)
    assert two.brain.cancelled.is_set()


def test_handles_of_what_is_shared_are_translated_and_others_do_not_cross(two: Two) -> None:
    move, middle = two.find("move"), two.find("middle")
    assert two.find("apply")(move, 0.5) == 0.5
    assert two.joint.written == [0.5]
    assert two.find("itself")() == middle
    [other] = two.anna.services(where(name="clock", container="anna"))
    with pytest.raises(errors.InvalidArgument, match="not shared with system memory"):
        two.find("apply")(other, 0.5)
    [cellar] = two.planner.services(where(name="move", group="cellar"))
    two.brain.home = cellar
    with pytest.raises(errors.NotSerialisable, match="not shared with system clinic"):
        two.find("itself")()


def test_services_that_come_and_go_at_home_come_and_go_in_the_other_system(two: Two) -> None:
    legs = Joint("legs")
    two.robot.register(legs, "rosie.legs")
    move = two.anna.find(where(name="move", group="rosie.legs"), wait_s=20)
    two.robot.set_health(legs, "hot")
    wait_until(lambda: move.health == "hot", "its health is announced")
    assert move(0.1) == 0.1
    two.robot.deregister(legs)
    wait_until(lambda: not move.alive, "it is withdrawn")
    with pytest.raises(errors.ServiceGone):
        move(0.2)
    middle = two.find("middle")
    two.lab.kill(two.robot)
    wait_until(lambda: not middle.alive, "it ended")


def test_another_list_withdraws_what_it_has_not_and_disturbs_nothing_else(two: Two) -> None:
    move, middle = two.find("move"), two.find("middle")
    with two.anna.open_session("one"):
        run = two.find("long").start()
        assert two.brain.entered.wait(20)
        two.find("go_on", two.bob)(1.0)
        two.border.share(exported=["rosie.mind", "cellar"], imported=[])
        assert two.joint.stopped.wait(20)  # no client in the other system could stop it any more
        wait_until(lambda: not move.alive, "its end is announced")
        assert middle.alive
        cellar = two.anna.find(where(name="move", group="cellar"), wait_s=20)
        assert cellar(0.3) == 0.3
        run.cancel()
        assert two.brain.cancelled.wait(20)


def test_S03_what_a_foreign_client_moves_stops_with_that_client_alone(two: Two) -> None:
    tail = Joint("tail")
    two.robot.register(tail, "rosie.tail")
    wag = two.bob.find(where(name="go_on", group="rosie.tail"), wait_s=20)
    wag(1.0)
    page = two.anna.open_session("page")
    with page.use():
        two.anna.find(where(name="go_on", group="rosie.head"), wait_s=20)(1.0)
    page.close()
    assert two.joint.stopped.wait(20)
    two.settle()
    assert tail.resource.moving
    two.clinic.kill(two.bob)
    assert tail.stopped.wait(20)


def test_S03_a_client_that_was_gone_when_its_call_came_moves_nothing(two: Two) -> None:
    go = two.find("go_on")
    page = two.anna.open_session("page")
    two.clinic.settle()  # its sign of life was seen: one that comes later would say that it is present
    two.theirs._parts.session_ended(page.name)
    with page.use(), pytest.raises(errors.SessionEnded):
        go(1.0)
    two.find("who")
    with page.use(), pytest.raises(errors.SessionEnded):
        two.find("middle")(Point(0, 0), Point(2, 4))  # a reading call opens no session for an unknown client either
    assert not two.joint.resource.moving


def test_S03_a_killed_federation_gateway_leaves_no_motion(two: Two) -> None:
    two.find("go_on")(1.0)
    two.lab.kill(two.ours)
    assert two.joint.stopped.wait(20)


def test_S05_a_federation_gateway_that_loses_the_other_system_leaves_no_motion(two: Two) -> None:
    two.find("go_on")(1.0)
    two.clinic.partition(two.anna, two.theirs)
    two.clinic.advance(3)
    assert two.joint.stopped.wait(20)


def test_S08_a_clients_own_stop_does_not_latch_and_a_foreign_one_does(two: Two) -> None:
    go, stop = two.find("go_on"), two.find("stop")
    go(1.0)
    stop()
    go(1.0)
    two.find("stop", two.bob)()
    with pytest.raises(errors.Stopped, match="clinic/bob via door"):
        go(1.0)
    assert two.anna.resume(where(group="rosie.head")) == ["pan"]
    go(1.0)
    two.planner.find(where(name="stop", group="rosie.head"))()
    with pytest.raises(errors.Stopped, match="planner"):
        go(1.0)


def test_a_lock_in_another_system_is_a_lock_at_home_under_the_clients_name(two: Two) -> None:
    at_home = two.planner.find(where(name="move", group="rosie.head"), wait_s=20)
    with two.anna.lock(where(group="rosie.head"), purpose="look") as lock:
        assert lock.resources == ("pan",)
        assert two.find("move")(0.1) == 0.1
        [there] = two.planner.locks()
        assert (there.holder.owner, there.holder.purpose) == ("clinic/anna via door", "look")
        with pytest.raises(errors.LockedByOther, match="clinic/anna via door"):
            at_home(0.9)
        with pytest.raises(errors.LockedByOther, match="anna/anna"):
            two.find("move", two.bob)(0.9)
        with pytest.raises(errors.LockedByOther), two.bob.lock(where(group="rosie.head"), wait_s=0):
            pass
    with two.bob.lock(where(group="rosie.head"), wait_s=0):  # given back on both sides when it returns
        pass
    assert at_home(0.2) == 0.2
    assert two.joint.written == [0.1, 0.2]


def test_an_owner_at_home_keeps_the_lock_and_is_asked_to_release_it(two: Two) -> None:
    asked: list[tuple[str, str]] = []
    heard = threading.Event()

    def hear(who: str, reason: str) -> None:
        asked.append((who, reason))
        heard.set()

    with two.planner.lock(where(group="rosie.head"), on_request=hear):
        with (
            pytest.raises(errors.LockedByOther, match="planner/planner"),
            two.anna.lock(where(group="rosie"), wait_s=0),
        ):
            pass
        assert two.anna.locks() == []
        with pytest.raises(errors.LockedByOther, match="planner/planner"):
            two.find("move")(0.1)
        assert two.anna.request_release(where(name="move"), "hurry") == ["planner/planner"]
        assert heard.wait(20)
    assert asked == [("clinic/anna via door", "hurry")]
    heard.clear()
    with two.anna.lock(where(group="rosie.head"), on_request=hear):
        assert two.planner.request_release(where(group="rosie.head"), "mine") == ["clinic/anna via door"]
        assert heard.wait(20)
    assert asked[1:] == [("planner/planner", "mine")]


def test_a_client_waiting_in_another_system_gets_the_lock_when_it_is_released_at_home(two: Two) -> None:
    with two.planner.lock(where(group="rosie.head")) as held:
        lock = two.anna.lock(where(group="rosie.head"), wait_s=30)
        taking = threading.Thread(target=lock.acquire)
        taking.start()
        wait_until(lambda: two.planner.locks()[0].waiting == ("clinic/anna via door",), "it waits at home")
        held.release()
    taking.join(30)
    with lock.use():
        assert two.find("move")(0.4) == 0.4
    lock.release()


@pytest.mark.parametrize("how", ["broken at home", "broken there", "owner dies", "border dies"])
def test_a_lock_that_is_lost_on_one_side_is_lost_on_both_and_what_it_moves_stops(two: Two, how: str) -> None:
    lost = threading.Event()
    lock = two.anna.lock(where(group="rosie.head"), on_lost=lambda _: lost.set()).acquire()
    with lock.use():
        two.find("go_on")(1.0)
    if how == "broken at home":
        two.planner.break_lock(where(group="rosie.head"), "mine")
    elif how == "broken there":
        two.bob.break_lock(where(group="rosie.head"), "mine")
    elif how == "owner dies":
        two.clinic.kill(two.anna)
    else:
        two.lab.kill(two.ours)
    assert two.joint.stopped.wait(20)
    wait_until(lambda: two.planner.locks() == [], "it ended at home")
    if how != "owner dies":
        assert lost.wait(20) or how == "border dies"
    with two.planner.lock(where(group="rosie.head"), wait_s=20):
        pass
    if "broken" in how:
        with pytest.raises(errors.LockLost), lock.use():
            two.find("move")(0.5)


def test_software_and_what_reads_are_locked_at_home_too(two: Two) -> None:
    long, middle = two.find("long"), two.find("middle")
    here = {handle.name: handle for handle in two.planner.services(where(group="rosie.mind"))}
    with two.anna.lock([two.find("who"), middle]):
        assert middle(Point(0, 0), Point(2, 4)) == Point(1, 2)
        for refused in (here["who"], lambda: here["middle"](Point(0, 0), Point(2, 4))):
            with pytest.raises(errors.LockedByOther, match="clinic/anna via door"):
                refused()
    assert long.alive


def test_S09_an_e_stop_holds_on_both_sides_and_is_cleared_on_each(two: Two) -> None:
    two.find("go_on")(1.0)
    report = two.bob.estop("smoke")
    assert report.complete
    assert two.joint.stopped.wait(20)
    wait_until(lambda: [one.id for one in two.planner.estops()] == [report.id], "it crossed")
    assert "in system clinic, by bob/bob" in two.planner.estops()[0].reason
    two.bob.estop_clear([report.id])
    with pytest.raises(errors.Stopped, match="smoke"):
        two.find("move")(0.1)
    assert two.planner.estop_clear([report.id]).complete
    two.planner.resume(where(group="rosie.head"))
    assert two.find("move")(0.1) == 0.1
    two.settle()
    assert two.planner.estops() == two.bob.estops() == []  # nothing of it comes back


@pytest.mark.parametrize("lost", [False, True])
def test_S09_an_e_stop_is_confirmed_once_it_holds_on_both_sides(two: Two, lost: bool) -> None:
    """Its order to the robot's container is lost, which a stop of each joint does not make up for."""
    if lost:
        two.lab.lose(lambda passage: passage.source == "door" and "/estop" in f"/{passage.key}")
    report = two.bob.estop("smoke")
    assert report.complete != lost
    assert (report.id in [one.id for one in two.robot.estops()]) != lost
    if lost:
        assert "guest/door" in {*report.missing, *report.failed}
    else:
        with pytest.raises(errors.Stopped, match="smoke"):
            two.planner.find(where(name="go_on", group="rosie.head"))(1.0)
        assert not two.joint.resource.moving


def test_S09_one_that_is_open_when_the_border_opens_crosses_too(two: Two) -> None:
    two.border.close()
    report = two.planner.estop("fire")
    with Border(two.ours, two.theirs, exported=["rosie"]):
        wait_until(lambda: [one.id for one in two.anna.estops()] == [report.id], "it crossed")


def test_what_is_shared_is_not_shared_back_nor_further(two: Two) -> None:
    two.anna.register(Brain(), "clinic.map")
    two.settle()
    two.border.share(exported=["*"], imported=["*"])
    map_here = two.planner.find(where(name="middle", group="clinic.map"), wait_s=20)
    assert map_here(Point(0, 0), Point(2, 4)) == Point(1, 2)
    two.settle()
    wait_until(lambda: two.anna.services(where(group="cellar")), "the longer list")
    for system in (two.planner, two.anna):
        assert len(system.services(where(name="middle"))) == 2  # one of each system
    with memory_system() as ward:
        nurse = member(ward, "nurse", "ward", "nurse")
        there, here = member(ward, "door", "ward", "guest"), member(two.clinic, "second", "clinic", "second")
        two.clinic.settle()
        with Border(here, there, exported=["*"]):
            ward.settle()
            assert {handle.groups[0] for handle in nurse.services(~where(group="trade"))} == {"clinic.map"}


def test_containers_of_both_systems_may_have_the_same_names(two: Two) -> None:
    namesake = member(two.clinic, "robot", "clinic", "rosie")
    tail = Joint("pan")
    namesake.register(tail, "rosie.head")
    two.clinic.settle()
    go = {handle.container: handle for handle in two.anna.services(where(name="go_on", group="rosie.head"))}
    assert sorted(go) == ["door", "robot"]
    go["robot"](1.0)
    assert not two.joint.resource.moving
    with two.anna.lock([go["door"]]):
        assert two.find("who")(note="n") == "n"
        go["robot"](1.0)


def test_a_second_resource_of_one_name_is_not_shared(two: Two, caplog: pytest.LogCaptureFixture) -> None:
    other = two.lab.container("other", identity="other")
    other.register(Joint("pan"), "rosie.twin")
    wait_until(lambda: "is not shared with clinic" in caplog.text, "it is said")
    assert "pan is another object already" in caplog.text
    assert not two.anna.services(where(group="rosie.twin"))
    two.lab.kill(two.robot)
    assert two.anna.find(where(name="move", group="rosie.twin"), wait_s=20)(0.1) == 0.1


def test_a_system_shares_nothing_with_itself(two: Two) -> None:
    with pytest.raises(errors.ConfigurationError, match="name another one"):
        Border(two.ours, two.planner)
