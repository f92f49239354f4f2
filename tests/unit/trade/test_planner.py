"""The planner of ``examples/planner.py`` knows a goal, and builds its plans from what services say of themselves."""

import threading
from typing import Any

import pytest
from msgspec import Struct

from examples import planner as example
from examples.planner import NoPlan, Planner, Step
from tests.support.waiting import PATIENCE_S, wait_until
from trade import Container, errors, service
from trade.testing import MemorySystem
from trade.transport.endpoints import free_endpoint

pytestmark = pytest.mark.virtual_time


class Spot(Struct, frozen=True):
    x_m: float


class Robot:
    """What was called, in order."""

    def __init__(self) -> None:
        self.calls: list[str] = []


class Part:
    def __init__(self, robot: Robot, name: str = "") -> None:
        self.robot, self.name = robot, name

    def note(self, *words: object) -> None:
        self.robot.calls.append(" ".join(map(str, filter(None, (self.name, *words)))))


class Camera(Part):
    @service(effect="read", achieves="see(?thing)")
    def look(self, thing: str) -> Spot:
        self.note("look", thing)
        return Spot(0.4)


class Arm(Part):
    @service(achieves=["unfolded(arm)"])
    def unfold(self) -> None:
        self.note("unfold")

    @service(needs=["see(?object)", "unfolded(arm)"], achieves=["holding(?object)"])
    def pick_up(self, spot: Spot, grip: float = 0.5) -> None:
        self.note("pick up", spot.x_m, grip)


class Base(Part):
    @service(needs=["at(?from)", "charged(base)"], achieves=["at(?to)"])
    def drive(self, to: str) -> None:
        self.note("drive", to)

    @service(needs="at(dock)", achieves="charged(base)")
    def charge(self) -> None:
        self.note("charge")


class Circle(Part):
    @service(needs="hen", achieves="egg")
    def lay(self) -> None: ...

    @service(needs="egg", achieves="hen")
    def hatch(self) -> None: ...

    @service(needs="charged", achieves="charged")
    def charge(self) -> None: ...

    @service(needs=["deep(f(?x))"], achieves=["deep(?x)"])
    def dig(self) -> None: ...


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.fixture
def planner(memory: MemorySystem) -> Planner:
    return Planner(memory.container("planner"), "rosie")


def offer(memory: MemorySystem, *providers: Part, container: str = "robot") -> None:
    for provider in providers:
        memory.container(container).register(provider, f"rosie.{provider.name or type(provider).__name__.lower()}")
    memory.settle()


def said(steps: list[Step]) -> list[str]:
    return [str(step) for step in steps]


def test_a_plan_is_built_from_what_the_services_need(memory: MemorySystem, planner: Planner, robot: Robot) -> None:
    offer(memory, Arm(robot), Camera(robot))
    assert said(planner.search("holding(mug)")) == [
        "rosie.camera.look(mug)",
        "rosie.arm.unfold()",
        "rosie.arm.pick_up(spot=<see(mug)>)",
    ]
    planner.achieve("holding(mug)")
    assert robot.calls == ["look mug", "unfold", "pick up 0.4 0.5"]
    planner.achieve("holding(mug)")
    assert len(robot.calls) == 3, "what holds already is not achieved again"


def test_variables_of_two_steps_with_one_service_differ(memory: MemorySystem, planner: Planner, robot: Robot) -> None:
    offer(memory, Base(robot))
    planner.facts["at(dock)"] = (memory.container("planner").services("rosie")[0], None)
    planner.achieve("at(kitchen)")
    assert robot.calls == ["charge", "drive kitchen"]


def test_a_variable_that_no_parameter_has_may_be_anything(memory: MemorySystem, planner: Planner, robot: Robot) -> None:
    class Lamp(Part):
        @service(achieves=["bright(?room)"])
        def shine(self) -> None:
            self.note("shine")

    offer(memory, Lamp(robot))
    planner.achieve("bright(kitchen)")
    assert robot.calls == ["shine"]


def test_an_argument_that_nothing_gives_is_the_reason_for_no_plan(
    memory: MemorySystem, planner: Planner, robot: Robot
) -> None:
    class Blind(Part):
        @service(achieves=["holding(?thing)"])
        def grasp(self, spot: Spot) -> None:
            self.note("grasp")

    offer(memory, Blind(robot))
    with pytest.raises(NoPlan, match=r"nothing says which spot rosie\.blind\.grasp gets"):
        planner.search("holding(mug)")
    assert robot.calls == []


CIRCLES = {
    "egg": "egg needs hen needs egg",
    "charged": "charged needs charged",
    "deep(hole)": "comes after 10 other pre-conditions",
    "see(mug)": r"no healthy service of rosie achieves see\(mug\)",
}


@pytest.mark.parametrize(("goal", "reason"), CIRCLES.items(), ids=list(CIRCLES))
def test_what_needs_itself_has_no_plan_and_the_reason_says_so(
    memory: MemorySystem, planner: Planner, robot: Robot, goal: str, reason: str
) -> None:
    offer(memory, Circle(robot))
    with pytest.raises(NoPlan, match=reason):
        planner.search(goal)


def test_a_search_among_too_many_services_ends(memory: MemorySystem, planner: Planner, robot: Robot) -> None:
    def go(self: Part) -> None: ...

    def copied(depth: int) -> Any:
        mark = service(needs=f"d{depth + 1}", achieves=f"d{depth}")
        return mark(type(go)(go.__code__, go.__globals__))

    maze = type("Maze", (Part,), {f"go{depth}": copied(depth) for depth in range(9)})
    offer(memory, *(maze(robot, f"maze{number}") for number in range(8)))
    with pytest.raises(NoPlan, match="the search was too long"):
        planner.search("d0")


def test_a_service_that_is_not_healthy_is_not_planned_with(
    memory: MemorySystem, planner: Planner, robot: Robot
) -> None:
    cameras = [Camera(robot, "first"), Camera(robot, "second")]
    offer(memory, *cameras)
    assert said(planner.search("see(mug)")) == ["rosie.first.look(mug)"]
    memory.container("robot").set_health(cameras[0], "too hot")
    memory.settle()
    assert said(planner.search("see(mug)")) == ["rosie.second.look(mug)"]


def test_a_service_that_goes_is_replaced_by_another_and_what_was_achieved_stays(
    memory: MemorySystem, planner: Planner, robot: Robot
) -> None:
    class Leaving(Camera):
        @service(effect="read", achieves="see(?thing)")
        def look(self, thing: str) -> Spot:
            memory.container("one").deregister(first)
            memory.settle()
            return super().look(thing)

    first, second = Arm(robot, "arm1"), Arm(robot, "arm2")
    offer(memory, first, container="one")
    offer(memory, second, Leaving(robot), container="two")
    planner.achieve("holding(mug)")
    assert robot.calls == ["look mug", "arm2 unfold", "arm2 pick up 0.4 0.5"]


def test_services_that_go_again_and_again_end_the_planning(
    memory: MemorySystem, planner: Planner, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone(Part):
        @service(achieves="done")
        def go(self) -> None:
            self.note("go")
            raise errors.ServiceGone(service="another one")

    offer(memory, Gone(robot))
    with pytest.raises(NoPlan, match="services went during each of 10 plans"):
        planner.achieve("done")
    assert robot.calls == ["go"] * example.MOST_PLANS


def test_all_that_moves_is_locked_while_the_plan_runs(memory: MemorySystem, planner: Planner, robot: Robot) -> None:
    class Watching(Arm):
        @service(achieves=["unfolded(arm)"])
        def unfold(self) -> None:
            held = memory.container("robot").locks()
            self.note(*sorted(f"{info.holder.purpose}: {name}" for info in held for name in info.resources))

    offer(memory, Watching(robot, "arm"), Camera(robot))
    planner.achieve("holding(mug)")
    assert robot.calls[1].count("holding(mug): ") == 2
    assert memory.container("robot").locks() == []


def test_another_clients_lock_ends_it_before_anything_moves(
    memory: MemorySystem, planner: Planner, robot: Robot
) -> None:
    offer(memory, Arm(robot), Camera(robot))
    hasty = Planner(memory.container("planner"), "rosie", wait_s=0.0)
    with memory.container("other").lock("rosie.arm"), pytest.raises(errors.LockedByOther):
        hasty.achieve("holding(mug)")
    assert robot.calls == []


def test_a_call_that_may_have_run_is_not_repeated(memory: MemorySystem, planner: Planner, robot: Robot) -> None:
    class Odd(Part):
        @service(achieves="done")
        def go(self) -> None:
            self.note("go")
            raise errors.OutcomeUnknown(service="rosie.odd.go", deadline_s=1.0)

    offer(memory, Odd(robot))
    with pytest.raises(errors.OutcomeUnknown):
        planner.achieve("done")
    assert robot.calls == ["go"]


def apart(start_container: Any, name: str) -> Container:
    at = free_endpoint()
    return start_container(name, listen=[at], connect=[at])


def nothing_waits(container: Container) -> bool:
    return not container.reach.discovers and container.notifications() == []


@pytest.mark.real_clock
def test_a_missing_service_is_discovered_and_discovery_is_off_again(start_container: Any, robot: Robot) -> None:
    mind, eyes = apart(start_container, "mind"), apart(start_container, "eyes")
    mind.register(Arm(robot), "rosie.arm")
    eyes.register(Camera(robot), "rosie.eyes")
    eyes.system.set_broadcast(True)
    Planner(mind, "rosie").achieve("holding(mug)")
    assert robot.calls == ["look mug", "unfold", "pick up 0.4 0.5"]
    assert nothing_waits(mind)


@pytest.mark.real_clock
def test_discovery_is_off_again_after_a_search_in_vain_and_nothing_was_called(
    start_container: Any, robot: Robot
) -> None:
    mind = start_container("mind")
    mind.register(Arm(robot), "rosie.arm")
    with pytest.raises(NoPlan, match=r"no healthy service of rosie achieves see\(mug\)"):
        Planner(mind, "rosie", wait_s=0.05).achieve("holding(mug)")
    assert robot.calls == []
    assert nothing_waits(mind)


@pytest.mark.real_clock
def test_a_service_that_joins_and_does_not_help_leaves_the_planner_searching(
    start_container: Any, robot: Robot
) -> None:
    mind = start_container("mind")
    search = threading.Thread(target=Planner(mind, "rosie").achieve, args=("see(mug)",))
    search.start()
    wait_until(lambda: mind.reach.discovers)
    mind.register(Arm(robot), "rosie.arm")
    mind.register(Camera(robot), "rosie.eyes")
    search.join(PATIENCE_S)
    assert robot.calls == ["look mug"]
    assert nothing_waits(mind)


def test_a_container_that_cannot_discover_says_so_and_waits_for_nothing(
    memory: MemorySystem, planner: Planner, robot: Robot
) -> None:
    with pytest.raises(errors.ConfigurationError, match="cannot change its links"):
        planner.achieve("see(mug)")
    assert memory.container("planner").notifications() == []
