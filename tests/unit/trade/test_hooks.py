"""``before_service`` and ``after_service``: watch any service from anywhere, change nothing of it."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, HookEvent, Secret, Settings, current_call, errors, service, where
from trade._context.call_context import CallContext
from trade._hooks.api import Hook
from trade._services.local_service import LocalService
from trade.errors import AccessDenied, ConfigurationError, NoSuchHook
from trade.testing import memory_system

pytestmark = pytest.mark.virtual_time


class Planner:
    def __init__(self) -> None:
        self.ran: list[tuple[str, int]] = []

    @service
    def plan(self, goal: str, steps: int = 3) -> list[str]:
        self.ran.append((goal, steps))
        if goal == "nothing":
            raise ValueError("no plan for nothing")
        return [goal] * steps

    @service(effect="read")
    def login(self, word: Secret[str]) -> bool:
        return len(word) > 3

    @service(effect="stop")
    def halt(self) -> None:
        self.ran.append(("halt", 0))


class Observer:
    def __init__(self) -> None:
        self.seen: queue.SimpleQueue[HookEvent] = queue.SimpleQueue()
        self.released = threading.Event()
        self.error: Exception | None = None
        self.times = 0

    @service(effect="read")
    def see(self, called: HookEvent) -> None:
        self.times += 1
        self.seen.put(called)
        if self.error is not None:
            raise self.error

    @service(effect="read")
    def dawdle(self, called: HookEvent) -> None:
        self.times += 1
        self.released.wait(5)

    def next(self) -> HookEvent:
        return self.seen.get(timeout=20)


@pytest.fixture
def usual_limit() -> None:
    """Hooks have the time that they have by default."""


@pytest.fixture(autouse=True)
def hooks_have_time(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hooks of most tests may take as long as a busy computer does."""
    if "usual_limit" not in request.fixturenames:
        monkeypatch.setenv("TRADE_HOOK_LIMIT_S", "30")


@pytest.fixture
def planner() -> Planner:
    return Planner()


@pytest.fixture
def observer() -> Observer:
    return Observer()


@pytest.fixture
def plan(there: Container, here: Container, planner: Planner) -> Handle:
    """Of a planner in the other container."""
    there.register(planner, "mind")
    return here.find(where(name="plan", group="mind"), wait_s=20)


@pytest.fixture
def watch(here: Container, there: Container, observer: Observer) -> Callable[[str], Handle]:
    handles = here.register(observer, "eye")
    wait_until(lambda: all(there.client.has(handle.key) for handle in handles))  # it calls them
    return lambda name: here.find(where(name=name, group="eye"))


# --- what a hook receives


def test_a_before_hook_receives_the_service_and_its_arguments(
    here: Container, plan: Handle, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.before_service(plan, watch("see"))
    assert plan("coffee") == ["coffee"] * 3
    called = observer.next()
    assert (called.service, called.args, called.ended) == (plan, {"goal": "coffee"}, False)
    assert (called.caller, called.session) == (here.address.identity, here.session)


def test_an_after_hook_receives_the_result_before_the_caller(
    here: Container, plan: Handle, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.after_service(plan, watch("see"))
    plan("tea", steps=2)
    called = observer.seen.get_nowait()
    assert (called.args, called.result, called.ok) == ({"goal": "tea", "steps": 2}, ["tea", "tea"], True)
    assert called.took_s > 0


def test_an_after_hook_receives_an_error_that_still_reaches_the_caller(
    here: Container, plan: Handle, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.after_service(plan, watch("see"))
    with pytest.raises(ValueError, match="no plan for nothing"):
        plan("nothing")
    called = observer.next()
    assert (called.ok, called.error, called.result) == (False, "ValueError: no plan for nothing", None)


def test_hooks_receive_secret_arguments_masked(
    here: Container, plan: Handle, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.after_service(where(name="login"), watch("see"))
    assert here.call(where(name="login"), "swordfish")
    called = observer.next()
    assert called.args == {"word": "***"}


def test_a_call_within_a_container_is_watched_too(
    there: Container, here: Container, plan: Handle, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.after_service(plan, watch("see"))
    there.call(where(name="plan"), "here")
    assert observer.next().args == {"goal": "here"}


def test_a_hook_gets_copies_and_changes_nothing(here: Container) -> None:
    class Box:
        @service(strict=False, effect="read")
        def fill(self, things: list[int]) -> list[int]:
            return things

    class Thief:
        @service(strict=False, effect="read")
        def steal(self, called: HookEvent) -> None:
            called.args["things"].clear()
            if called.ended:
                called.result.clear()

    [fill] = here.register(Box(), "box")
    [steal] = here.register(Thief(), "thief")
    here.before_service(fill, steal)
    here.after_service(fill, steal)
    assert fill([1, 2]) == [1, 2]


# --- whom it watches


def test_a_constraint_covers_services_that_join_later(
    here: Container, there: Container, watch: Callable[[str], Handle], observer: Observer
) -> None:
    hook = here.after_service(where(group="mind"), watch("see"))
    wait_until(lambda: any(info.container == there.name for info in hook.infos()))
    there.register(Planner(), "mind")
    here.call(where(name="plan", group="mind"), "late")
    assert observer.next().args == {"goal": "late"}


def test_a_constraint_covers_containers_that_join_later(
    here: Container, start_container: Any, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.after_service(where(group="mind"), watch("see"))
    late = start_container("late")
    wait_until(lambda: any(info.container == "late" for info in here.hooks()))
    late.register(Planner(), "mind")
    here.call(where(name="plan", group="mind"), "later")
    assert observer.next().args == {"goal": "later"}


def test_a_service_that_no_longer_matches_is_no_longer_watched(
    here: Container, there: Container, planner: Planner, plan: Handle, watch: Callable[[str], Handle]
) -> None:
    hook = here.after_service(where(group="mind"), watch("see"))
    there.set_groups(planner, "body")
    plan("unseen")
    assert sum(info.fired for info in hook.infos()) == 0
    assert [info.services for info in hook.infos() if info.container == there.name] == [()]


def test_what_is_detached_is_not_called_any_more(
    here: Container, plan: Handle, watch: Callable[[str], Handle], observer: Observer
) -> None:
    hook = here.after_service(plan, watch("see"))
    plan("once")
    hook.detach()
    hook.detach()
    plan("twice")
    assert observer.times == 1
    assert here.hooks() == []


def test_what_is_detached_stays_so_while_it_is_being_attached_to_who_comes(
    here: Container, start_container: Any, watch: Callable[[str], Handle], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go, over, attach = threading.Event(), threading.Event(), threading.Event(), Hook._attach

    def late(self: Hook, handle: Handle) -> Any:
        if handle.container == "late":
            begun.set()
            go.wait(20)
        return attach(self, handle)

    join = Hook._join

    def joined(self: Hook, handle: Handle) -> None:
        join(self, handle)
        if handle.container == "late":
            over.set()

    monkeypatch.setattr(Hook, "_attach", late)
    monkeypatch.setattr(Hook, "_join", joined)
    hook = here.after_service(where(name="plan"), watch("see"))
    start_container("late")
    assert begun.wait(20)
    hook.detach()
    go.set()
    assert over.wait(20)
    assert here.hooks() == []


def test_a_hook_is_attached_once_its_container_knows_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trade._registry.registry._KNOWN_WITHIN_S", 60)
    planner, observer = Planner(), Observer()
    with memory_system() as system, ThreadPoolExecutor(1, "attaching") as other:
        here, there = system.container("here"), system.container("there")
        there.register(planner, "mind")
        system.settle()
        system.partition(here, there, one_way=True)
        here.register(observer, "eye")
        third = system.container("third")
        system.settle()
        attaching = other.submit(third.before_service, third.find("mind.plan"), third.find("eye.see"))
        assert not wait([attaching], 0.3).done
        system.heal(here, there)
        attaching.result(20)
        third.call("mind.plan", "x")
        assert observer.next().args == {"goal": "x"}


def test_a_hook_is_listed_and_detached_from_anywhere(
    here: Container, there: Container, plan: Handle, watch: Callable[[str], Handle]
) -> None:
    hook = here.after_service(plan, watch("see"))
    [info] = there.hooks()
    assert (info.id, info.side, info.call, info.target) == (hook.id, "after", "eye.see", "mind.plan")
    assert (info.owner, info.container, info.services) == (here.session, there.name, ("mind.plan",))
    there.detach_hook(info.id)
    assert here.hooks() == []
    with pytest.raises(NoSuchHook, match=info.id):
        there.detach_hook(info.id)


def test_a_hook_ends_with_the_container_that_attached_it(there: Container, plan: Handle, start_container: Any) -> None:
    brief = start_container("brief")
    brief.register(Observer(), "eye")
    brief.after_service(brief.find(where(name="plan"), wait_s=20), brief.find(where(name="see")))
    assert len(there.hooks()) == 1
    brief.close()
    wait_until(lambda: there.hooks() == [])


# --- chains


def test_a_hook_may_be_watched_and_circles_end(here: Container, there: Container, plan: Handle) -> None:
    class Nosy:
        seen: queue.SimpleQueue[str] = queue.SimpleQueue()

        @service(effect="read")
        def look(self, called: HookEvent) -> None:
            self.seen.put(called.service.name)

        @service(effect="read")
        def peek(self, called: HookEvent) -> None:
            self.seen.put(called.service.name)

    here.register(Nosy(), "nosy")
    look, peek = here.find(where(name="look")), here.find(where(name="peek"))
    here.after_service(plan, look)
    here.after_service(look, peek)
    circle = here.after_service(peek, look)
    plan("coffee")
    assert [Nosy.seen.get(timeout=20) for _ in range(2)] == ["plan", "look"]
    assert Nosy.seen.empty()
    assert [info.skipped for info in circle.infos()] == [1]


def test_a_hook_belongs_to_the_chain_of_the_call_and_has_none_of_its_locks(
    here: Container, there: Container, plan: Handle
) -> None:
    class Curious:
        context: Any = None

        @service(effect="read")
        def look(self, called: HookEvent) -> None:
            Curious.context = current_call()

    [look] = here.register(Curious(), "curious")
    here.before_service(plan, look)
    with here.lock([plan]):
        plan("coffee")
    assert Curious.context.chain == ("mind.plan",)
    assert Curious.context.tokens == ()


# --- what a hook cannot do


def test_a_hook_that_fails_changes_nothing_and_is_suspended_in_the_end(
    here: Container,
    plan: Handle,
    watch: Callable[[str], Handle],
    observer: Observer,
    caplog: pytest.LogCaptureFixture,
) -> None:
    observer.error = OSError("no film")
    hook = here.before_service(plan, watch("see"))
    with caplog.at_level(logging.WARNING, "trade"):
        for _ in range(5):
            assert plan("coffee", 1) == ["coffee"]
        wait_until(lambda: "attached from here, is suspended" in caplog.text)
    assert observer.times == 3
    [info] = hook.infos()
    assert (info.failures, info.suspended, info.last_error) == (3, True, "OSError: no film")


def test_a_setting_gives_hooks_more_time(monkeypatch: pytest.MonkeyPatch, observer: Observer) -> None:
    class Slow:
        @service(effect="read")
        def write(self, called: HookEvent) -> None:
            threading.Event().wait(0.4)  # longer than hooks have by default
            observer.seen.put(called)

    monkeypatch.setenv("TRADE_HOOK_LIMIT_S", "30")
    with Container(Settings.read(container="mind")) as home:
        home.register(Planner(), "mind")
        [write] = home.register(Slow(), "log")
        hook = home.after_service("mind.plan", write)
        home.call("mind.plan", "coffee")
        assert observer.next().ok
        [info] = hook.infos()
        assert (info.fired, info.failures) == (1, 0)


@pytest.mark.parametrize("limit", ["0", "-1", "61", "soon", "nan"])
def test_an_impossible_limit_of_hooks_is_a_configuration_error(limit: str) -> None:
    with pytest.raises(ConfigurationError, match="TRADE_HOOK_LIMIT_S"):
        Settings.read(environment={"TRADE_HOOK_LIMIT_S": limit})


@pytest.mark.realtime
@pytest.mark.usefixtures("usual_limit")
def test_a_slow_hook_is_cut_off(
    here: Container, plan: Handle, watch: Callable[[str], Handle], observer: Observer
) -> None:
    hook = here.before_service(plan, watch("dawdle"))
    for _ in range(4):
        plan("coffee")
    observer.released.set()
    [info] = hook.infos()
    assert info.suspended
    assert "cut off" in info.last_error
    assert observer.times == 3


@pytest.mark.realtime
@pytest.mark.usefixtures("usual_limit")
def test_a_slow_hook_in_the_same_container_is_cut_off_too(here: Container, observer: Observer) -> None:
    [plan, *_] = here.register(Planner(), "mind")
    here.register(observer, "eye")
    hook = here.before_service(plan, here.find(where(name="dawdle")))
    assert plan("coffee", 1) == ["coffee"]
    observer.released.set()
    assert hook.infos()[0].failures == 1


@pytest.mark.usefixtures("usual_limit")
def test_what_is_too_late_after_its_hooks_does_not_run(
    here: Container, plan: Handle, planner: Planner, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.before_service(plan, watch("dawdle"))
    with pytest.raises((errors.DeadlineExceeded, errors.OutcomeUnknown)):
        plan.with_(deadline_s=0.05)("coffee")
    observer.released.set()
    time.sleep(0.2)
    assert planner.ran == []


def test_the_gates_are_checked_after_the_hooks(
    here: Container, there: Container, plan: Handle, planner: Planner, start_container: Any
) -> None:
    other = start_container("other")

    class Grabber:
        @service(effect="read")
        def grab(self, called: HookEvent) -> None:
            self.lock = other.lock(where(name="plan"), purpose="mine now")
            self.lock.acquire()

    grabber = Grabber()
    here.register(grabber, "grab")
    other.find(where(name="plan"), wait_s=20)
    here.before_service(plan, here.find(where(name="grab")))
    with pytest.raises(errors.LockedByOther, match="mine now"):
        plan("coffee")
    assert planner.ran == []
    grabber.lock.release()


@pytest.mark.usefixtures("usual_limit")
def test_nothing_comes_before_a_stop_and_what_comes_after_does_not_hold_it_up(
    here: Container, plan: Handle, planner: Planner, watch: Callable[[str], Handle], observer: Observer
) -> None:
    halt = here.find(where(name="halt"))
    with pytest.raises(ConfigurationError, match=r"mind.halt: nothing comes before a stop"):
        here.before_service(halt, watch("see"))
    here.before_service(where(group="mind"), watch("see"))
    here.after_service(where(group="mind"), watch("dawdle"))
    halt.with_(deadline_s=20)()
    assert not observer.released.is_set()
    assert planner.ran == [("halt", 0)]
    wait_until(lambda: observer.times == 1)  # the one after it
    observer.released.set()


@pytest.mark.parametrize("call", [print, None], ids=["function", "none"])
def test_what_cannot_be_called_there_is_refused(here: Container, plan: Handle, call: Any) -> None:
    with pytest.raises(ConfigurationError, match="call must be a handle"):
        here.before_service(plan, call)


def test_what_is_neither_a_service_nor_a_text_is_not_watched(here: Container, watch: Callable[[str], Handle]) -> None:
    with pytest.raises(ConfigurationError, match=r"trade\.before_service: say which services by where"):
        here.before_service(7, watch("see"))  # type: ignore[arg-type]


def test_hooks_do_not_observe_the_built_in_services(
    here: Container, watch: Callable[[str], Handle], observer: Observer
) -> None:
    here.after_service(where(), watch("see"))
    here.find(where(name="clock", container=here.name))()
    assert observer.times == 0


def test_hooks_need_the_right_to_instrument(start_container: Any, tmp_path: Any, system: str) -> None:
    policy = tmp_path / "policy.toml"
    text = """
[roles.all]
call = ["*"]
read = ["*"]
register = ["*"]
lock = ["*"]
administer = ["*"]

[identities]
"*" = ["all"]
"""
    policy.write_text(text)
    here = start_container("here", policy=policy)
    [plan, *_] = here.register(Planner(), "mind")
    here.register(Observer(), "eye")
    with pytest.raises(AccessDenied, match="instrument"):
        here.after_service(plan, here.find(where(name="see")))
    with pytest.raises(AccessDenied, match="instrument"):
        here.after_service(where(group="mind"), here.find(where(name="see")))
    policy.write_text(text.replace("lock =", 'instrument = ["mind"]\nlock ='))
    here.load_policy(policy)
    hook = here.after_service(plan, here.find(where(name="see")))
    plan("coffee")
    assert hook.infos()[0].fired == 1
    policy.write_text(text)
    here.load_policy(policy)
    plan("coffee")
    assert hook.infos()[0].fired == 1
    assert hook.infos()[0].services == ()


def test_a_call_succeeds_when_the_last_hook_is_detached_as_it_starts(
    here: Container, planner: Planner, observer: Observer, watch: Callable[[str], Handle]
) -> None:
    [plan, *_] = here.register(planner, "mind")
    here.before_service(plan, watch("see"))
    hooked = here._parts.providers.service(plan.key)
    assert hooked is not None

    class Detached(LocalService):
        """Its hooks are there at the first look at them, and gone at the second."""

        looks: Iterator[Any] = iter([hooked.interceptors])

        @property
        def interceptors(self) -> Any:  # type: ignore[override]
            return next(self.looks, ())

    service = object.__new__(Detached)
    for name in LocalService.__slots__:
        if name != "interceptors":
            setattr(service, name, getattr(hooked, name))
    context = CallContext(7, hooked.label, "ui", here.session, time.monotonic_ns() + 10**10)
    assert service.call(("tea", 1), {}, context) == ["tea"]


class Slow:
    def __init__(self) -> None:
        self.released = threading.Event()

    @service(effect="read")
    def sleep(self, called: HookEvent) -> None:
        self.released.wait(1000)


def test_all_hooks_of_one_side_take_no_longer_together_than_two_and_a_half_of_them_may(
    here: Container, plan: Handle
) -> None:
    here.register(slow := Slow(), "slow")
    sleep = here.find(where(name="sleep"), wait_s=20)
    for _ in range(3):
        here.before_service(plan, sleep)
    began = time.monotonic()
    assert plan.with_(deadline_s=600)("tea", steps=1) == ["tea"]
    limit_s = here.settings.hook_limit_s
    assert 2.4 * limit_s < time.monotonic() - began < 2.6 * limit_s
    slow.released.set()
