"""Guards refuse calls before these run: with a reason, and whenever a check does not clearly let them through."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

import trade
from tests.support.waiting import wait_until
from trade import Container, Handle, HookEvent, errors, service, where
from trade.errors import CallRefused, Cancelled, ConfigurationError, MotionStopped

pytestmark = pytest.mark.virtual_time


class Arm:
    resources = ("arm",)

    def __init__(self) -> None:
        self.ran: list[tuple[Any, ...]] = []
        self.door_open = False

    def _closed_door(self, call: HookEvent) -> str | None:
        return f"the door is open for {call.args['x_m']} m" if self.door_open else None

    @service(guard=_closed_door)
    def reach(self, x_m: float) -> float:
        self.ran.append(("reach", x_m))
        return x_m

    @service
    def grasp(self, width_m: float) -> None:
        self.ran.append(("grasp", width_m))

    @service(effect="read")
    def pose(self) -> float:
        self.ran.append(("pose",))
        return 1.0

    @service(effect="stop")
    def halt(self) -> None:
        self.ran.append(("halt",))


class Checks:
    """Checks whose answers a test decides."""

    def __init__(self) -> None:
        self.seen: list[HookEvent] = []
        self.begun = threading.Event()
        self.decided = threading.Event()
        self.answer: Any = None

    def decide(self, call: HookEvent) -> str | None:
        self.seen.append(call)
        return self.answer

    def hang(self, call: HookEvent) -> str | None:
        self.seen.append(call)
        self.begun.set()
        self.decided.wait(60)
        return self.answer

    @service(effect="read")
    def ask(self, call: HookEvent) -> str:
        self.seen.append(call)
        return "the person says no" if call.args["width_m"] > 0.05 else ""


@pytest.fixture
def checks() -> Iterator[Checks]:
    made = Checks()
    yield made
    made.decided.set()


@pytest.fixture
def arm(there: Container) -> Arm:
    made = Arm()
    there.register(made, "rosie.arm")
    return made


@pytest.fixture(params=["local", "remote"])
def find(request: pytest.FixtureRequest, here: Container, there: Container, arm: Arm) -> Callable[[str], Handle]:
    """Finds services of the arm, in the container that has it or in the other one."""
    caller = there if request.param == "local" else here
    return lambda name: caller.find(where(name=name, group="rosie.arm"), wait_s=20)


@pytest.fixture
def grasp(find: Callable[[str], Handle]) -> Handle:
    return find("grasp")


def test_a_guard_refuses_with_its_reason_and_nothing_runs(
    there: Container, arm: Arm, grasp: Handle, checks: Checks
) -> None:
    checks.answer = "the light curtain is broken"
    guard = there.guard("rosie.arm.grasp", checks.decide)
    with pytest.raises(CallRefused, match=r"rosie\.arm\.grasp .* guard decide: the light curtain is broken") as refused:
        grasp(0.02)
    assert (refused.value.guard, refused.value.reason) == ("decide", "the light curtain is broken")
    assert arm.ran == []
    assert (guard.passed, guard.refused) == (0, 1)
    [seen] = checks.seen
    assert (seen.args, seen.ended, seen.service.name) == ({"width_m": 0.02}, False, "grasp")


def test_a_guard_lets_a_call_through_and_alters_nothing(
    there: Container, arm: Arm, grasp: Handle, checks: Checks
) -> None:
    guard = there.guard("rosie.arm", checks.decide)
    grasp(0.02)
    checks.answer = ""
    grasp(width_m=0.03)
    assert arm.ran == [("grasp", 0.02), ("grasp", 0.03)]
    assert (guard.passed, guard.refused) == (2, 0)


def test_the_guard_of_a_mark_gets_the_object_and_the_call(arm: Arm, find: Callable[[str], Handle]) -> None:
    reach = find("reach")
    assert reach(0.5) == 0.5
    arm.door_open = True
    with pytest.raises(CallRefused, match=r"guard closed_door: the door is open for 0\.6 m"):
        reach(0.6)
    assert arm.ran == [("reach", 0.5)]


def test_the_guard_of_a_function_gets_the_call(there: Container) -> None:
    @service(effect="read", guard=lambda call: "negative" if call.args["number"] < 0 else None)
    def root(number: float) -> float:
        return number**0.5

    there.register(root, "maths")
    find = there.find("maths.root")
    assert find(4.0) == 2.0
    with pytest.raises(CallRefused, match="negative"):
        find(-4.0)


def test_guards_of_marks_and_of_programs_apply_together(there: Container, arm: Arm, checks: Checks) -> None:
    reach = there.find("rosie.arm.reach")
    checks.answer = "not now"
    with there.guard("rosie.arm.reach", checks.decide) as guard:
        with pytest.raises(CallRefused, match="not now"):
            reach(0.1)
        arm.door_open = True
        with pytest.raises(CallRefused, match="the door is open"):
            reach(0.1)
        assert guard.refused == 1  # the mark's guard comes first
    with pytest.raises(CallRefused, match="the door is open"):
        reach(0.1)
    arm.door_open = False
    assert reach(0.1) == 0.1
    assert there.guards() == []


def test_a_removed_guard_refuses_nothing(there: Container, arm: Arm, grasp: Handle, checks: Checks) -> None:
    checks.answer = "no"
    guard = there.guard(where(group="rosie.arm"), checks.decide)
    other = there.guard(where(group="rosie.arm"), lambda _: None)
    assert there.guards() == [guard, other]
    guard.remove()
    guard.remove()
    grasp(0.02)
    assert (arm.ran, checks.seen, other.passed) == ([("grasp", 0.02)], [], 1)


def test_a_constraint_guards_services_that_join_or_match_later(there: Container, checks: Checks) -> None:
    checks.answer = "this room is closed"
    there.guard(where(group="lab"), checks.decide)
    early, late = Arm(), Arm()
    there.register(early, ["rosie.arm", "lab"])
    there.register(late, "max.arm")
    with pytest.raises(CallRefused):
        there.call("rosie.arm.grasp", 0.02)
    there.call("max.arm.grasp", 0.02)
    there.add_group(late, "lab")
    there.remove_group(early, "lab")
    with pytest.raises(CallRefused):
        there.call("max.arm.grasp", 0.03)
    there.call("rosie.arm.grasp", 0.03)
    assert (early.ran, late.ran) == ([("grasp", 0.03)], [("grasp", 0.02)])


def test_services_have_their_guards_before_anyone_can_call_them(there: Container, checks: Checks) -> None:
    checks.answer = "no"
    there.guard(where(group="lab"), checks.decide)
    arm, errors = Arm(), list[BaseException | None]()
    there.joined(where(name="grasp", group="lab"), lambda handle: errors.append(handle.start(0.02).exception()))
    there.register(arm, "lab")
    wait_until(lambda: errors)
    assert isinstance(errors[0], CallRefused)
    assert arm.ran == []


@pytest.mark.parametrize("answer", [True, False, 0, 3.5, ["no"]], ids=str)
def test_an_answer_that_is_no_text_refuses(
    there: Container, arm: Arm, grasp: Handle, checks: Checks, answer: object
) -> None:
    checks.answer = answer
    there.guard("rosie.arm", checks.decide)
    with pytest.raises(CallRefused, match="a check returns a text that says why not, or None"):
        grasp(0.02)
    assert arm.ran == []


@pytest.mark.parametrize("error", [ValueError, SystemExit, KeyboardInterrupt, errors.Stopped], ids=lambda e: e.__name__)
def test_a_check_that_fails_refuses(there: Container, arm: Arm, grasp: Handle, error: type[BaseException]) -> None:
    def broken(call: HookEvent) -> str | None:
        raise error("the sensor is gone") if error is not errors.Stopped else ConfigurationError(problem="it is gone")

    there.guard("rosie.arm", broken)
    with pytest.raises(CallRefused, match=r"its check failed with .*gone"):
        grasp(0.02)
    assert arm.ran == []


def test_a_check_that_hangs_refuses_and_so_do_the_next_ones(
    there: Container, arm: Arm, grasp: Handle, checks: Checks
) -> None:
    guard = there.guard("rosie.arm.grasp", checks.hang, limit_s=0.01)
    for _ in range(32):
        with pytest.raises(CallRefused, match=r"its check did not answer within 0\.01 s"):
            grasp(0.02)
    with pytest.raises(CallRefused, match="32 of its checks have not ended"):
        grasp(0.02)
    assert (len(checks.seen), guard.refused) == (32, 33)
    checks.decided.set()
    there.find("rosie.arm.pose")()  # others never waited
    wait_until(lambda: _passes(grasp))
    assert arm.ran == [("pose",), ("grasp", 0.02)]


def _passes(grasp: Handle) -> bool:
    try:
        grasp(0.02)
    except CallRefused:
        return False
    return True


def test_a_check_that_calls_what_it_guards_refuses_that(there: Container, arm: Arm, grasp: Handle) -> None:
    inner: list[BaseException | None] = []

    def circle(call: HookEvent) -> str | None:
        inner.append(call.service.start(0.01).exception())
        return "it asked itself"

    there.guard("rosie.arm.grasp", circle)
    with pytest.raises(CallRefused, match="it asked itself"):
        grasp(0.02)
    [refused] = inner
    assert isinstance(refused, CallRefused)
    assert refused.reason == "its check led to this call itself"
    assert arm.ran == []


def test_a_check_may_read_other_services(there: Container, arm: Arm, grasp: Handle) -> None:
    pose = there.find("rosie.arm.pose")
    there.guard("rosie.arm.grasp", lambda _: "too high" if pose() > 0.5 else None)
    with pytest.raises(CallRefused, match="too high"):
        grasp(0.02)
    assert arm.ran == [("pose",)]


def test_a_service_of_another_container_decides(
    here: Container, there: Container, arm: Arm, grasp: Handle, checks: Checks
) -> None:
    here.register(checks, "person")
    there.guard("rosie.arm.grasp", there.find("person.ask", wait_s=20), limit_s=20)
    grasp(0.02)
    with pytest.raises(CallRefused, match=r"guard person\.ask: the person says no"):
        grasp(0.06)
    here.deregister(checks)
    with pytest.raises(CallRefused, match="ServiceGone"):
        grasp(0.02)
    assert arm.ran == [("grasp", 0.02)]


def test_a_stop_during_the_check_ends_the_call(there: Container, arm: Arm, grasp: Handle, checks: Checks) -> None:
    there.guard("rosie.arm.grasp", checks.hang, limit_s=60)
    moving = grasp.start(0.02)
    assert checks.begun.wait(20)
    there.call("rosie.arm.halt")
    checks.decided.set()
    assert isinstance(moving.exception(20), MotionStopped | Cancelled)
    assert arm.ran == [("halt",)]


def test_a_call_that_is_cancelled_during_the_check_does_not_run(
    there: Container, arm: Arm, grasp: Handle, checks: Checks
) -> None:
    there.guard("rosie.arm.grasp", checks.hang, limit_s=60)
    moving = grasp.start(0.02)
    assert checks.begun.wait(20)
    moving.cancel()
    assert isinstance(moving.exception(20), Cancelled)  # though the check has not ended
    assert arm.ran == []


def test_a_check_ends_with_the_deadline_of_the_call(there: Container, arm: Arm, grasp: Handle, checks: Checks) -> None:
    there.guard("rosie.arm.grasp", checks.hang, limit_s=60)
    with pytest.raises((CallRefused, TimeoutError)):
        grasp.with_(deadline_s=0.2)(0.02)
    checks.decided.set()
    there.call("rosie.arm.pose")
    assert arm.ran == [("pose",)]


def test_a_stop_is_never_guarded(there: Container, arm: Arm, find: Callable[[str], Handle], checks: Checks) -> None:
    checks.answer = "no"
    there.guard("rosie.arm", checks.decide)
    find("halt")()
    assert (arm.ran, checks.seen) == ([("halt",)], [])


def test_what_cannot_be_guarded_is_a_configuration_error(here: Container, there: Container, arm: Arm) -> None:
    async def later(call: HookEvent) -> str | None:
        return None

    halt, remote = there.find("rosie.arm.halt"), here.find("rosie.arm.grasp", wait_s=20)
    wrong: list[tuple[Callable[[], object], str]] = [
        (lambda: there.guard(halt, lambda _: None), "nothing may refuse it"),
        (lambda: there.guard(there.find("trade.hooks", container="there"), lambda _: None), "nothing may refuse it"),
        (lambda: here.guard(remote, lambda _: None), "container there, which alone can guard it"),
        (lambda: there.guard("rosie.arm", later), "a guard is a plain function"),
        (lambda: there.guard("rosie.arm", 5), "a guard is a plain function"),  # type: ignore[arg-type]
        (lambda: there.guard("rosie.arm", lambda _: None, limit_s=0), "limit_s"),
        (lambda: there.guard("rosie.arm", lambda _: None, limit_s="1"), "limit_s"),  # type: ignore[arg-type]
        (lambda: there.guard(5, lambda _: None), "guard"),  # type: ignore[arg-type]
        (lambda: service(effect="stop", guard=lambda _: None), "nothing may refuse it"),
        (lambda: service(guard=later), "a guard is a plain function"),
    ]
    for make, says in wrong:
        with pytest.raises(ConfigurationError, match=says):
            make()
    assert (here.guards(), there.guards()) == ([], [])


def test_programs_use_guards_of_the_default_container() -> None:
    assert {"Guard", "guard", "guards"} <= set(trade.__all__)


def test_a_hook_sees_the_refusal(there: Container, arm: Arm, checks: Checks) -> None:
    heard = list[HookEvent]()

    class Log:
        @service(effect="note")
        def note(self, called: HookEvent) -> None:
            heard.append(called)

    there.register(Log(), "log")
    there.after_service("rosie.arm.grasp", there.find("log.note"))
    checks.answer = "no"
    there.guard("rosie.arm.grasp", checks.decide)
    with pytest.raises(CallRefused):
        there.call("rosie.arm.grasp", 0.02)
    assert [called.error.partition(":")[0] for called in heard] == ["CallRefused"]


def test_many_calls_pass_a_guard_at_the_same_time(there: Container, grasp: Handle, arm: Arm) -> None:
    guard = there.guard("rosie.arm.pose", lambda _: None, limit_s=60)
    pose = there.find("rosie.arm.pose")
    with ThreadPoolExecutor(8, "calling") as pool:
        assert list(pool.map(lambda _: pose(), range(200))) == [1.0] * 200
    assert guard.passed == 200
