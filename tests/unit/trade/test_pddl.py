"""Services as a planning domain: a planner that others wrote reads it, and finds plans in it."""

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jupyddl
import pytest

from trade import Container, Handle, pddl_domain, service, where
from trade._registry.registry import Record
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import ServiceInfo
from trade.testing import memory_system

pytestmark = pytest.mark.virtual_time


class Arm:
    @service(needs=["see(?thing)", "at(?place)"], achieves=["holding(?thing)", "not(empty)"])
    def pick_up(self) -> None: ...

    @service(needs=["holding(?thing)", "at(?place)"], achieves=["on(?thing, ?place)", "not(holding(?thing))", "empty"])
    def put_down(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


class Eyes:
    @service(effect="read", needs=["not(dark)", "at(?place)"], achieves="see(?anything)")
    def look(self) -> None: ...


class Base:
    @service(needs=["holding(mug)"], achieves=["at(pose(1, 2))", "at(Dock.1)", "at(dock-1)"])
    def drive(self) -> None: ...

    @service(achieves=["at(3)", "at(dock, now)", "object(me)"])
    def home(self) -> None: ...


class Odd:
    """Needs what it achieves, and two that need each other."""

    @service(needs="charged", achieves="charged")
    def charge(self) -> None: ...

    @service(needs="hen", achieves="egg")
    def lay(self) -> None: ...

    @service(needs="egg", achieves="hen")
    def hatch(self) -> None: ...


@pytest.fixture
def robot() -> Iterator[Container]:
    with memory_system() as system:
        yield system.container("robot")


Solve = Callable[..., Sequence[str] | None]


@pytest.fixture
def solve(tmp_path: Path) -> Solve:
    """The shortest plan for a goal, by a planner that others wrote; None if it proves that there is none."""

    def plan(domain: str, goal: str, *, objects: str = "", init: str = "") -> Sequence[str] | None:
        name = domain.partition("(define (domain ")[2].partition(")")[0]
        problem = f"(define (problem p) (:domain {name}) (:objects {objects}) (:init {init}) (:goal {goal}))"
        files = [tmp_path / "domain.pddl", tmp_path / "problem.pddl"]
        for file, text in zip(files, (domain, problem), strict=True):
            file.write_text(text, encoding="utf-8")
        found = jupyddl.solve(*map(str, files), search="bfs", heuristic=None)
        assert found.solved or not found.truncated
        return [" ".join(re.findall(r"[\w-]+", step)) for step in found.plan_names()] if found.solved else None

    return plan


def test_a_planner_finds_the_services_of_a_plan_in_their_order(robot: Container, solve: Solve) -> None:
    for provider in (Arm(), Eyes(), Base()):
        robot.register(provider, f"rosie.{type(provider).__name__.lower()}")
    domain = pddl_domain(robot.services("rosie"), "rosie")
    assert solve(domain, "(on mug dock-1)", objects="mug", init="(empty)") == [
        "rosie-base-home",
        "rosie-eyes-look x-3 mug",
        "rosie-arm-pick_up mug x-3",
        "rosie-base-drive",
        "rosie-arm-put_down mug dock-1",
    ]
    assert solve(domain, "(holding mug)", objects="mug", init="(dark)") is None
    taking = pddl_domain(robot.services(where(group="rosie") & ~where(name="put_down")))
    assert solve(taking, "(holding mug)", objects="mug", init="(empty)") is not None
    assert solve(taking, "(and (holding mug) (empty))", objects="mug", init="(empty)") is None


def test_a_domain_says_what_each_service_needs_and_achieves(robot: Container) -> None:
    robot.register(Arm(), "rosie.arm")
    assert (
        pddl_domain(robot.services("rosie"), "Rosie's arm")
        == """\
; Services of a TRADE system as actions, by their pre-conditions and post-conditions.
(define (domain rosie-s-arm)
  (:requirements :strips)
  (:predicates (at ?x0) (empty) (holding ?x0) (on ?x0 ?x1) (see ?x0))

  ; rosie.arm.pick_up in container robot
  (:action rosie-arm-pick_up
    :parameters (?thing ?place)
    :precondition (and (see ?thing) (at ?place))
    :effect (and (holding ?thing) (not (empty))))

  ; rosie.arm.put_down in container robot
  (:action rosie-arm-put_down
    :parameters (?thing ?place)
    :precondition (and (holding ?thing) (at ?place))
    :effect (and (on ?thing ?place) (not (holding ?thing)) (empty)))
)
"""
    )


def test_names_that_pddl_does_not_allow_are_changed_and_stay_different(robot: Container, solve: Solve) -> None:
    robot.register(Base(), "rosie.base")
    domain = pddl_domain(robot.services("rosie"))
    assert {line for line in domain.splitlines() if line.startswith("; ") and " is " in line} == {
        "; at-2 is at",  # with two arguments
        "; object-2 is object",
        "; dock-1-2 is Dock.1",
        "; pose-1-2 is pose(1, 2)",
        "; x-3 is 3",
    }
    assert solve(domain, "(and (at x-3) (at-2 dock now) (object-2 me))") == ["rosie-base-home"]


def test_conditions_in_a_circle_are_exported_and_have_no_plan(robot: Container, solve: Solve) -> None:
    robot.register(Odd(), "odd")
    domain = pddl_domain(robot.services("odd"))
    assert all(solve(domain, goal) is None for goal in ("(charged)", "(egg)", "(hen)"))
    assert solve(domain, "(hen)", init="(egg)") == ["odd-hatch"]


def test_services_that_achieve_the_same_are_an_action_each(robot: Container, solve: Solve) -> None:
    for group in ("rosie.left", "rosie.right", "rosie"):
        robot.register(Eyes(), group)
    robot.register(Eyes(), "rosie")
    domain = pddl_domain(robot.services("rosie"))
    actions = [line.split()[1] for line in domain.splitlines() if "(:action" in line]
    assert actions == ["rosie-left-look", "rosie-look", "rosie-look-2", "rosie-right-look"]
    assert len(solve(domain, "(see mug)", objects="mug", init="(at mug)") or ()) == 1
    assert domain == pddl_domain(reversed(robot.services("rosie")))


def test_a_system_without_conditions_is_a_domain_without_actions(robot: Container, solve: Solve) -> None:
    domain = pddl_domain(robot.services())
    assert "(:action" not in domain
    assert solve(domain, "(and)") == []


class Anywhere:
    """A container of a registry that holds anything; see `foreign`."""

    def record(self, handle: Handle) -> Record | None:
        return handle.last_record


def foreign(name: str, needs: Sequence[str], achieves: Sequence[str]) -> Handle:
    """A service as a container in any language may describe it."""
    key = ServiceKey(Address("peer", "odd", "e1"), "rosie", "p", name)
    info = ServiceInfo(name=name, signature="()", needs=tuple(needs), achieves=tuple(achieves))
    record = Record(key, info, ("rosie",), "Odd", "host", 1, False, (), {}, "healthy", {})
    return Handle(Anywhere(), key, record)  # type: ignore[arg-type]


LEFT_OUT = {
    "at(pose(?x), now)": "PDDL has no term with a variable inside: pose(?x)",
    "not(?x)": "not() takes one predicate",
    "not(not(a))": "not() takes one predicate",
    "see(": "'see(' is no predicate",
    "?x": "'?x' is no condition",
}


@pytest.mark.parametrize(("condition", "reason"), LEFT_OUT.items(), ids=list(LEFT_OUT))
@pytest.mark.parametrize("field", ["needs", "achieves"])
def test_what_pddl_cannot_express_is_left_out_and_said(condition: str, reason: str, field: str, solve: Solve) -> None:
    given: Any = {"needs": [], "achieves": ["done"], field: [condition, "done"]}
    domain = pddl_domain([foreign("odd", **given), foreign("go", [], ["see(?x)"])])
    [comment] = [line for line in domain.splitlines() if line.startswith("; left out")]
    assert comment.startswith("; left out: rosie.odd: ")
    assert reason in comment
    assert solve(domain, "(see mug)", objects="mug") == ["rosie-go mug"]


def test_a_name_of_another_container_breaks_out_of_no_comment(solve: Solve) -> None:
    name = "go\n(:action evil :parameters () :precondition (and) :effect (and (see mug)))\n;"
    domain = pddl_domain([foreign(name, ["never"], ["see(?x)"]), foreign(name, [], ["see("])])
    assert "\n(:action evil" not in domain
    assert solve(domain, "(see mug)", objects="mug") is None
