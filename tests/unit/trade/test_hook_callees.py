"""What a hook and a guard call: it may restart, and it may need more time than other ones."""

import time
from collections.abc import Iterator

import pytest

from trade import Container, Handle, Hook, HookEvent, HookInfo, Settings, service, where
from trade.errors import CallRefused, ConfigurationError
from trade.testing import MemorySystem, memory_system

pytestmark = pytest.mark.virtual_time


class Planner:
    def __init__(self) -> None:
        self.ran: list[str] = []

    @service
    def plan(self, goal: str) -> str:
        self.ran.append(goal)
        return goal


class Observer:
    def __init__(self, takes_s: float = 0.0) -> None:
        self.seen: list[str] = []
        self.cut_off = 0
        self._takes_s = takes_s

    @service(effect="read")
    def see(self, called: HookEvent) -> None:
        time.sleep(self._takes_s)
        self.seen.append(called.args["goal"])

    @service(effect="read")
    def judge(self, called: HookEvent) -> str | None:
        return "it is dark" if called.args["goal"] == "night" else None


@pytest.fixture(autouse=True)
def usual_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """On virtual time, hooks have the time that they have by default."""
    monkeypatch.setitem(Settings.__init__.__kwdefaults__, "hook_limit_s", 0.1)


@pytest.fixture
def memory() -> Iterator[MemorySystem]:
    with memory_system() as system:
        yield system


@pytest.fixture
def mind(memory: MemorySystem) -> Container:
    return memory.container("mind")


@pytest.fixture
def planner(mind: Container) -> Planner:
    planner = Planner()
    mind.register(planner, "mind")
    return planner


@pytest.fixture
def plan(memory: MemorySystem, planner: Planner) -> Handle:
    return memory.container("desk").find(where(name="plan"), wait_s=5)


def observer_in(memory: MemorySystem, name: str = "eye") -> Observer:
    """An observer in a container of that name, which is started if there is none."""
    observer = Observer()
    memory.container(name).register(observer, "eye")
    memory.container("mind").find(where(name="see", container=name), wait_s=5)
    return observer


def state_of(hook: Hook) -> HookInfo:
    [info] = [info for info in hook.infos() if info.container == "mind"]
    return info


def killed(memory: MemorySystem, name: str) -> None:
    """End a container as `kill -9` does, until the others have seen it."""
    memory.kill(name)
    for _ in range(100):
        if all(one.container != name for one in memory.container("mind").services(where())):
            return
        memory.advance(0.1)
    pytest.fail(f"{name} is still there")


@pytest.mark.parametrize("callee", [where(name="see"), "eye.see"])
def test_a_hook_that_calls_by_a_constraint_follows_a_restart(
    memory: MemorySystem, planner: Planner, plan: Handle, callee: object
) -> None:
    first = observer_in(memory)
    hook = memory.container("desk").after_service("mind.plan", call=callee)  # type: ignore[arg-type]
    plan("one")
    killed(memory, "eye")
    for _ in range(5):
        plan("unseen")
    info = state_of(hook)
    assert (info.fired, info.skipped, info.failures, info.suspended) == (1, 5, 0, False)
    assert "no service matches" in info.last_error
    second = observer_in(memory)
    plan("two")
    assert (first.seen, second.seen) == (["one"], ["two"])
    assert planner.ran == ["one", *["unseen"] * 5, "two"]


def test_a_hook_that_calls_a_handle_ends_with_its_provider(memory: MemorySystem, plan: Handle) -> None:
    observer_in(memory)
    desk = memory.container("desk")
    hook = desk.after_service("mind.plan", call=desk.find(where(name="see"), wait_s=5))
    killed(memory, "eye")
    second = observer_in(memory)
    for _ in range(5):
        plan("unseen")
    assert (state_of(hook).suspended, second.seen) == (True, [])


def test_a_hook_that_failed_before_the_loss_was_seen_continues_with_the_next_provider(
    memory: MemorySystem, mind: Container, plan: Handle
) -> None:
    """A host that loses power is in the registry until its lease ends: three calls suffice to suspend a hook."""
    observer_in(memory)
    hook = memory.container("desk").after_service("mind.plan", call=where(name="see"))
    memory.partition("mind", "eye")
    for _ in range(4):
        plan("unseen")
    assert state_of(hook).suspended
    killed(memory, "eye")
    second = observer_in(memory)
    plan("seen")
    assert (state_of(hook).suspended, second.seen) == (False, ["seen"])


def test_two_services_are_no_callee(memory: MemorySystem, plan: Handle) -> None:
    both = [observer_in(memory, name) for name in ("eye", "ear")]
    hook = memory.container("desk").after_service("mind.plan", call=where(name="see"))
    for _ in range(5):
        plan("unseen")
    info = state_of(hook)
    assert (info.suspended, info.fired, [one.seen for one in both]) == (True, 0, [[], []])
    assert "2 services match" in info.last_error


@pytest.mark.parametrize(("limit_s", "seen"), [(2.0, ["one"] * 4), (None, [])])
def test_a_hook_has_the_time_that_it_asks_for(
    memory: MemorySystem, mind: Container, plan: Handle, limit_s: float | None, seen: list[str]
) -> None:
    log = Observer(takes_s=0.3)
    mind.register(log, "log")
    hook = memory.container("desk").after_service("mind.plan", call=where(name="see"), limit_s=limit_s)
    for _ in range(4):
        assert plan("one") == "one"
    time.sleep(1)
    info = state_of(hook)
    assert (info.fired, info.suspended) == (len(seen), not seen)
    assert log.seen[:4] == (seen or ["one"] * 3)  # what was cut off ends by itself
    assert seen or "longer than the 0.1 s" in info.last_error


def test_hooks_of_one_side_together_have_two_and_a_half_times_the_longest_limit(
    memory: MemorySystem, mind: Container, planner: Planner, plan: Handle
) -> None:
    hooks: list[Hook] = []
    for number in range(5):
        mind.register(Observer(takes_s=0.3), f"log{number}")
        call = where(name="see", group=f"log{number}")
        hooks.append(memory.container("desk").before_service("mind.plan", call=call, limit_s=0.4))
    began = time.monotonic()
    plan("one")
    assert time.monotonic() - began == pytest.approx(1.0, abs=0.05)
    assert [(state_of(hook).fired, state_of(hook).failures) for hook in hooks] == [(1, 0)] * 3 + [(0, 1), (0, 0)]
    assert state_of(hooks[4]).skipped == 1
    assert planner.ran == ["one"]


@pytest.mark.parametrize("limit_s", [0.0, -1.0, 60.1, float("nan"), float("inf")])
def test_an_impossible_limit_attaches_nothing(memory: MemorySystem, plan: Handle, limit_s: float) -> None:
    observer = observer_in(memory)
    desk = memory.container("desk")
    with pytest.raises(ConfigurationError, match=r"limit_s must be above 0 and at most 60 seconds, not"):
        desk.before_service("mind.plan", call=where(name="see"), limit_s=limit_s)
    plan("one")
    assert (desk.hooks(), observer.seen) == ([], [])


def test_a_guard_that_asks_by_a_constraint_follows_a_restart_and_refuses_without_its_check(
    memory: MemorySystem, mind: Container, planner: Planner, plan: Handle
) -> None:
    observer_in(memory)
    mind.guard("mind.plan", where(name="judge"))
    plan("day")
    with pytest.raises(CallRefused, match="it is dark"):
        plan("night")
    killed(memory, "eye")
    with pytest.raises(CallRefused, match="no service matches name='judge'"):
        plan("day")
    observer_in(memory)
    plan("day")
    with pytest.raises(CallRefused, match="it is dark"):
        plan("night")
    assert planner.ran == ["day", "day"]
