"""A planner that knows only its goal: what each service needs and achieves, the services say themselves.

Run each in a process of its own. The camera connects to no other container, so the others do not know it:

    python examples/planner.py arm
    TRADE_LISTEN=tcp/127.0.0.1:7461 TRADE_CONNECT=tcp/127.0.0.1:7461 python examples/planner.py camera
    python examples/planner.py planner 'holding(mug)'
"""

import contextlib
import inspect
import itertools
import queue
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from msgspec import Struct

import trade
from trade import Container, Handle, Settings, errors, service, where

WAIT_S = 30.0
MOST_PLANS = 10
DEEPEST = 10
"""How many pre-conditions may stand behind each other."""
MOST_STEPS = 5000
"""When a search gives up."""


class Place(Struct, frozen=True):
    x_m: float
    y_m: float


class Camera:
    """A stand-in for a camera with object recognition."""

    @service(effect="read", achieves=["see(?object_type)"])
    def check_for(self, object_type: str) -> Place:
        """Where the nearest thing of that type is."""
        return {"mug": Place(0.4, -0.1), "plate": Place(0.5, 0.2)}[object_type]


class Arm:
    """A stand-in for an arm."""

    @service(achieves=["unfolded(arm)"])
    def unfold(self) -> None:
        print("arm: unfolding", flush=True)

    @service(needs=["see(?object)", "unfolded(arm)"], achieves=["holding(?object)"])
    def pick_up(self, place: Place) -> None:
        print(f"arm: picking up at {place.x_m:+.1f} m, {place.y_m:+.1f} m", flush=True)


# --- conditions


def parts(condition: str) -> list[str]:
    """``on(cup, ?x)`` as ``on``, ``cup``, ``?x``; a term such as ``pose(1, 2)`` is one part."""
    name, opened, inner = condition.replace(" ", "").partition("(")
    found, depth = [name, ""] if opened else [name], 0
    for sign in inner[:-1]:
        depth += (sign == "(") - (sign == ")")
        if sign == "," and not depth:
            found.append("")
        else:
            found[-1] += sign
    return found


def meaning(text: str, bindings: Mapping[str, str]) -> str:
    """A condition or a term whose variables are replaced by what they stand for."""

    def bound(variable: re.Match[str]) -> str:
        known = bindings.get(variable[0])
        return variable[0] if known is None else meaning(known, bindings)

    return re.sub(r"\?[\w.+-]+", bound, text)


def unified(one: str, other: str, bindings: Mapping[str, str]) -> Mapping[str, str] | None:
    """The bindings with which two conditions are the same; None if there are none."""
    left, right = parts(one), parts(other)
    if (left[0], len(left)) != (right[0], len(right)):
        return None
    for pair in zip(left[1:], right[1:], strict=True):
        here, there = (meaning(term, bindings) for term in pair)
        if here != there:
            if not here.startswith("?"):
                here, there = there, here
            if not here.startswith("?") or here in there:
                return None
            bindings = {**bindings, here: there}
    return bindings


# --- plans


class NoPlan(Exception):
    """No plan achieves the goal; the reasons are sentences."""

    def __init__(self, goal: str, reasons: Sequence[str]) -> None:
        super().__init__(f"no plan for {goal}: {'; '.join(reasons)}")


class Result(NamedTuple):
    """An argument: the result of the service that achieved a condition."""

    condition: str


@dataclass(frozen=True)
class Step:
    """A call of a plan, with its conditions. In the middle of a search, they have variables of this step only."""

    handle: Handle
    needs: tuple[str, ...]
    achieves: tuple[str, ...]
    number: int
    arguments: Mapping[str, str | Result] = field(default_factory=dict[str, str | Result])

    def __str__(self) -> str:
        given = (f"{name}=<{text.condition}>" if isinstance(text, Result) else text for name, text in self.given())
        return f"{self.handle.label}({', '.join(given)})"

    def given(self) -> list[tuple[str, str | Result]]:
        return list(self.arguments.items())


class _Plan(NamedTuple):
    steps: tuple[Step, ...] = ()
    bindings: Mapping[str, str] = {}


class Planner:
    """Achieves goals with the services of a group.

    Args:
        container: finds, locks and calls the services.
        group: the group.
        wait_s: how long it waits for a missing service, and for a lock, in seconds.
    """

    def __init__(self, container: Container, group: str, wait_s: float = WAIT_S) -> None:
        self._container = container
        self._group = group
        self._wait_s = wait_s
        self.facts: dict[str, tuple[Handle, Any]] = {}
        """What has been achieved: by which service, and its result."""
        self._numbers = itertools.count(1)
        self._left = 0
        self._reasons: dict[str, None] = {}

    def achieve(self, goal: str) -> None:
        """Plans, locks what moves, and makes the calls; plans again if a service goes meanwhile.

        Raises:
            NoPlan: no plan achieves the goal, also with the services that discovery finds.
            TradeError: a call failed, or it is not known whether it ran.
        """
        for _ in range(MOST_PLANS):
            steps = self.plan(goal)
            print(f"planner: plan: {', '.join(map(str, steps)) or 'nothing to do'}", flush=True)
            try:
                with self._locked(steps, goal):
                    for step in steps:
                        self._call(step)
            except (errors.ServiceGone, errors.NoSuchService, errors.LockLost) as gone:
                print(f"planner: planning again, because {gone}", flush=True)
            else:
                print(f"planner: {goal}", flush=True)
                return
        raise NoPlan(goal, [f"services went during each of {MOST_PLANS} plans"])

    def _locked(self, steps: Sequence[Step], goal: str) -> contextlib.AbstractContextManager[object]:
        """A lock of all that the plan moves, until its end."""
        moving = [step.handle for step in steps if step.handle.effect == "actuate"]
        if not moving:
            return contextlib.nullcontext()
        return self._container.lock(moving, purpose=goal, wait_s=self._wait_s)

    def _call(self, step: Step) -> None:
        given = {name: self.facts[of.condition][1] if isinstance(of, Result) else of for name, of in step.given()}
        try:
            result = step.handle(**given)
        except (errors.ContainerLost, errors.OutcomeUnknown) as lost:
            if step.handle.effect != "read":
                raise  # it may have run: only a person can see what the robot does now
            raise errors.ServiceGone(service=step.handle.label, reason=str(lost)) from lost
        print(f"planner: {step.handle.label}: {', '.join(step.achieves)}", flush=True)
        self.facts.update(dict.fromkeys(step.achieves, (step.handle, result)))

    def plan(self, goal: str) -> list[Step]:
        """A plan with the known services; if there is none, it searches the network, and stops that again."""
        try:
            return self.search(goal)
        except NoPlan as none:
            print(f"planner: {none}; searching", flush=True)
        came: queue.SimpleQueue[Handle] = queue.SimpleQueue()
        waiting = self._container.joined(where(group=self._group), came.put)
        try:
            return self._discovered(goal, came)
        finally:
            try:
                self._container.system.set_discovery(False)
            finally:
                waiting.cancel()

    def _discovered(self, goal: str, came: "queue.SimpleQueue[Handle]") -> list[Step]:
        """The first plan that is possible with the services that join meanwhile."""
        ends = time.monotonic() + self._wait_s
        self._container.system.set_discovery(True)
        while True:
            try:
                return self.search(goal)
            except NoPlan as none:
                try:
                    joined = came.get(timeout=max(0.0, ends - time.monotonic()))
                except queue.Empty:
                    raise none from None
                print(f"planner: {joined.label} has joined in container {joined.container}", flush=True)

    # --- search, from the goal back to what needs nothing

    def search(self, goal: str) -> list[Step]:
        """A plan with the known services, in the order of its calls. Raises NoPlan."""
        self._left = MOST_STEPS
        self._reasons = {}
        for plan in self._plans([goal], _Plan(), ()):
            steps = [self._ready(step, plan) for step in plan.steps]
            if None not in steps:
                return [step for step in steps if step is not None]
        if self._left <= 0:
            self._because("the search was too long")
        raise NoPlan(goal, list(self._reasons) or ["nothing is known"])

    def _because(self, reason: str) -> None:
        self._reasons[reason] = None

    def _plans(self, goals: Sequence[str], plan: _Plan, above: tuple[str, ...]) -> Iterator[_Plan]:
        """All plans that go on from one, and achieve the goals one after the other."""
        if not goals:
            yield plan
            return
        for longer in self._plans_of(meaning(goals[0], plan.bindings), plan, above):
            yield from self._plans(goals[1:], longer, above)

    def _plans_of(self, goal: str, plan: _Plan, above: tuple[str, ...]) -> Iterator[_Plan]:
        for condition in (*self.facts, *(each for step in plan.steps for each in step.achieves)):
            bindings = unified(goal, condition, plan.bindings)
            if bindings is not None:
                yield plan._replace(bindings=bindings)
        shape = re.sub(r"\?[\w.+-]+", "?", goal)
        if shape in above:
            self._because(" needs ".join((*above[above.index(shape) :], shape)))
        elif len(above) == DEEPEST:
            self._because(f"{shape} comes after {DEEPEST} other pre-conditions")
        else:
            yield from self._plans_by(goal, plan, (*above, shape))

    def _plans_by(self, goal: str, plan: _Plan, above: tuple[str, ...]) -> Iterator[_Plan]:
        """The plans whose last step achieves the goal."""
        able = self._container.services(where(achieves=goal, group=self._group, healthy=True))
        if not able:
            self._because(f"no healthy service of {self._group} achieves {above[-1]}")
        for handle in sorted(able, key=lambda handle: (len(handle.needs), handle.label, handle.container)):
            for bindings, step in self._uses(handle, goal, plan.bindings):
                for ready in self._plans(step.needs, plan._replace(bindings=bindings), above):
                    yield ready._replace(steps=(*ready.steps, step))

    def _uses(self, handle: Handle, goal: str, bindings: Mapping[str, str]) -> Iterator[tuple[Mapping[str, str], Step]]:
        """The steps with a service that achieve a goal; each has variables of its own."""
        for condition in handle.achieves:
            self._left -= 1
            number = next(self._numbers)
            bound = unified(goal, _numbered(condition, number), bindings)
            if bound is not None and self._left > 0:
                needs, achieves = (
                    tuple(_numbered(each, number) for each in texts) for texts in (handle.needs, handle.achieves)
                )
                yield bound, Step(handle, needs, achieves, number)

    def _ready(self, step: Step, plan: _Plan) -> Step | None:
        """A step with its arguments; None if nothing gives one of them."""
        needs, achieves = (
            tuple(meaning(each, plan.bindings) for each in texts) for texts in (step.needs, step.achieves)
        )
        arguments: dict[str, str | Result] = {}
        for name, parameter in inspect.signature(step.handle).parameters.items():
            given = self._argument(step, name, needs, plan)
            if given is not None:
                arguments[name] = given
            elif parameter.default is parameter.empty:
                self._because(f"nothing says which {name} {step.handle.label} gets")
                return None
        return Step(step.handle, needs, achieves, step.number, arguments)

    def _argument(self, step: Step, name: str, needs: Sequence[str], plan: _Plan) -> str | Result | None:
        """What the variable of the same name stands for, or the result of a service that achieves a pre-condition."""
        variable = f"?{name}.{step.number}"
        value = meaning(variable, plan.bindings)
        if not value.startswith("?"):
            return value
        wanted = _kind(step.handle.schema["arguments"]["properties"].get(name, {}))
        made = {condition: handle for condition, (handle, _) in self.facts.items()}
        made |= {meaning(each, plan.bindings): one.handle for one in plan.steps for each in one.achieves}
        fits = (need for need in needs if need in made and _kind(made[need].schema["result"]) == wanted)
        return next((Result(need) for need in fits), None)


def _numbered(condition: str, number: int) -> str:
    """A condition with the variables of one step: ``?x`` of two steps may mean different things."""
    return re.sub(r"\?[\w.+-]+", rf"\g<0>.{number}", condition)


def _kind(schema: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON Schema without what only describes it."""
    return {key: value for key, value in schema.items() if key not in ("$defs", "default", "description", "title")}


def offer(provider: object, group: str) -> None:
    """Register the provider until this process ends, and let others find it."""
    handles = trade.register(provider, group)
    trade.system.set_broadcast(True)
    print(f"{sys.argv[1]}: {', '.join(handle.label for handle in handles)}", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    container = trade.start(Settings.read(container=sys.argv[1]))
    try:
        match sys.argv[1]:
            case "camera":
                offer(Camera(), "rosie.eyes")
            case "arm":
                offer(Arm(), "rosie.arm")
            case _:
                Planner(container, "rosie").achieve(sys.argv[2])
    except (errors.TradeError, NoPlan) as failed:
        sys.exit(f"{type(failed).__name__}: {failed}")
