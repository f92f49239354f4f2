"""``pick=``: one of several services that fit, and the next one if a call never ran."""

import asyncio
import socket
import threading
from collections.abc import Callable
from typing import Any

import pytest
from msgspec import structs

from tests.support.waiting import wait_until
from trade import Container, Handle, errors, service, where
from trade._calls import picking
from trade.errors import Busy, ConfigurationError, LockedByOther, NoSuchService, ServiceGone, TooManyServices
from trade.testing import MemorySystem

pytestmark = pytest.mark.virtual_time

NAMES = ("one", "two", "three")


class Planner:
    def __init__(self) -> None:
        self.plans: list[str] = []
        self.raises: Exception | None = None

    @service
    def plan(self, goal: str) -> str:
        self.plans.append(goal)
        if self.raises is not None:
            raise self.raises
        return goal


Planners = dict[str, Planner]


@pytest.fixture
def planners(memory: MemorySystem) -> Planners:
    """One in each of three containers; a client, ``here``, knows them all."""
    made = {name: Planner() for name in NAMES}
    for name, planner in made.items():
        memory.container(name).register(planner, "mind")
    memory.container("here")
    memory.settle()
    return made


@pytest.fixture
def here(memory: MemorySystem) -> Container:
    return memory.container("here")


def counts(planners: Planners) -> list[int]:
    return [len(planners[name].plans) for name in NAMES]


def load(memory: MemorySystem, monkeypatch: pytest.MonkeyPatch, name: str, **values: Any) -> None:
    """What a container reports of its load."""
    meter = memory.container(name)._parts.load_meter
    reported = structs.replace(meter.read(), in_flight=0, queued=0, host_cpu_percent=0.0, **values)
    monkeypatch.setattr(meter, "read", lambda: reported)


def test_without_pick_several_are_an_error(here: Container, planners: Planners) -> None:
    with pytest.raises(TooManyServices):
        here.call("mind.plan", "tea")
    assert counts(planners) == [0, 0, 0]


@pytest.mark.parametrize("pick", ["any", "nearest", "least_busy", "local"])
def test_one_of_several_is_called_once(here: Container, planners: Planners, pick: Any) -> None:
    assert here.call("mind.plan", "tea", pick=pick) == "tea"
    assert asyncio.run(here.acall(where(name="plan"), goal="milk", pick=pick)) == "milk"
    assert here.find("mind.plan", pick=pick)("sugar") == "sugar"
    assert sum(counts(planners)) == 3


def test_any_shares_the_calls(here: Container, planners: Planners) -> None:
    for number in range(60):
        here.call("mind.plan", str(number), pick="any")
    assert all(count >= 3 for count in counts(planners))


def test_nearest_and_local_prefer_the_own_container_then_the_own_host(
    here: Container, memory: MemorySystem, planners: Planners, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = Planner()
    here.register(own, "mind")
    for pick in ("local", "nearest"):
        for _ in range(8):
            here.call("mind.plan", "tea", pick=pick)
    assert (len(own.plans), counts(planners)) == (16, [0, 0, 0])
    here.deregister(own)
    monkeypatch.setattr(socket, "gethostname", lambda: "another-host")
    far = Planner()
    memory.container("far").register(far, "mind")  # it says that it is on the other host
    memory.settle()
    monkeypatch.undo()
    for pick in ("local", "nearest"):
        for _ in range(8):
            here.call("mind.plan", "tea", pick=pick)
    assert (len(far.plans), sum(counts(planners))) == (0, 16)


def test_local_never_leaves_the_host(here: Container, planners: Planners, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "another-host")
    with pytest.raises(NoSuchService, match="another-host"):
        here.find("mind.plan", pick="local", wait_s=0)
    assert here.find("mind.plan", pick="nearest", wait_s=0).name == "plan"


@pytest.mark.parametrize(
    "busy",
    [
        [{"in_flight": 8}, {"in_flight": 2}, {"in_flight": 5}],
        [{"queued": 8}, {"queued": 2}, {"queued": 5}],
        [{"host_cpu_percent": 80.0}, {"host_cpu_percent": 10.0}, {"host_cpu_percent": 40.0}],
        [{"in_flight": 8, "cores": 2}, {"in_flight": 9, "cores": 16}, {"in_flight": 7, "cores": 2}],
        [{"calls_per_s": 8.0}, {"calls_per_s": 2.0}, {"calls_per_s": 5.0}],
    ],
    ids=["calls", "queues", "processors", "cores", "rates"],
)
def test_the_least_busy_is_called(
    here: Container,
    memory: MemorySystem,
    planners: Planners,
    monkeypatch: pytest.MonkeyPatch,
    busy: list[dict[str, Any]],
) -> None:
    quiet = {"in_flight": 0, "queued": 0, "host_cpu_percent": 0.0, "calls_per_s": 0.0, "cores": 4}
    for name, values in zip(NAMES, busy, strict=True):
        meter = memory.container(name)._parts.load_meter
        reported = structs.replace(meter.read(), **{**quiet, **values})
        monkeypatch.setattr(meter, "read", lambda reported=reported: reported)
    for _ in range(5):
        here.call("mind.plan", "tea", pick="least_busy")
    assert counts(planners) == [0, 5, 0]


def test_a_container_that_does_not_report_its_load_comes_last(
    here: Container, memory: MemorySystem, planners: Planners, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> None:
        raise OSError("no /proc")

    for name in ("one", "three"):
        monkeypatch.setattr(memory.container(name)._parts.load_meter, "read", broken)
    for _ in range(5):
        here.call("mind.plan", "tea", pick="least_busy")
    assert counts(planners) == [0, 5, 0]


@pytest.mark.parametrize("pick", ["any", "nearest", "least_busy", "local"])
def test_the_next_one_is_called_if_the_first_is_gone_before_it_ran(
    here: Container, memory: MemorySystem, planners: Planners, pick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    order = picking.Picker.order

    def gone_meanwhile(self: picking.Picker, records: Any, pick: Any) -> Any:
        found = sorted(order(self, records, pick), key=lambda record: NAMES.index(record.container))
        memory.container("one").deregister(planners["one"])
        memory.settle()
        return found

    monkeypatch.setattr(picking.Picker, "order", gone_meanwhile)
    assert here.call("mind.plan", "tea", pick=pick) == "tea"
    assert counts(planners) == [0, 1, 0]


def test_an_error_of_the_service_itself_calls_no_other(here: Container, memory: MemorySystem) -> None:
    """Also one of the types that would mean that the call never ran."""
    for error in (ServiceGone(service="mind.plan"), Busy(service="mind.plan", container="one"), ValueError("tea")):
        made = {name: Planner() for name in NAMES}
        for name, planner in made.items():
            planner.raises = error
            memory.container(name).register(planner, "mind")
        memory.settle()
        with pytest.raises(type(error)):
            here.call("mind.plan", "tea", pick="any")
        assert sum(counts(made)) == 1
        for name, planner in made.items():
            memory.container(name).deregister(planner)


def test_a_provider_in_the_own_container_whose_helper_is_gone_is_not_called_again_elsewhere(
    here: Container, memory: MemorySystem
) -> None:
    """The helper's error is the very object that the caller gets; only the helper never ran."""
    helper, runs = Planner(), list[str]()
    memory.container("helper").register(helper, "mind.helper")
    memory.settle()
    gone = here.find("mind.helper.plan")
    memory.container("helper").deregister(helper)
    memory.settle()

    class Delegating:
        def __init__(self, name: str) -> None:
            self._name = name

        @service(strict=False)
        def solve(self, goal: str) -> str:
            runs.append(self._name)
            return gone(goal)

    here.register(Delegating("own"), "solver")
    memory.container("one").register(Delegating("other"), "solver")
    memory.settle()
    with pytest.raises(ServiceGone):
        here.call("solver.solve", "tea", pick="local")
    assert runs == ["own"]


def test_all_gone_is_the_error_of_the_last_one(here: Container, memory: MemorySystem, planners: Planners) -> None:
    handles = here.services("mind.plan")
    for name in NAMES:
        memory.container(name).deregister(planners[name])
    memory.settle()
    with pytest.raises(ServiceGone):
        here.client._picker.call(handles, ("tea",), {})
    with pytest.raises(NoSuchService):
        here.find("mind.plan", pick="any", wait_s=0)


def test_a_locked_service_is_an_error_as_without_pick(
    here: Container, memory: MemorySystem, planners: Planners
) -> None:
    """That one arm is taken is no reason to move another one."""
    with memory.container("two").lock("mind"):
        with pytest.raises(LockedByOther):
            here.call("mind.plan", "tea", pick="any")
        assert counts(planners) == [0, 0, 0]


def test_calls_that_one_client_makes_at_once_are_shared(here: Container, memory: MemorySystem) -> None:
    """Each pick counts the calls under way that the reports do not show yet."""
    entered, leave = threading.Semaphore(0), threading.Event()
    ran = {name: list[str]() for name in NAMES}

    class Slow:
        def __init__(self, name: str) -> None:
            self._name = name

        @service(effect="read")
        def work(self, job: str) -> str:
            ran[self._name].append(job)
            entered.release()
            leave.wait(30)
            return job

    for name in NAMES:
        memory.container(name).register(Slow(name), "shop")
    memory.settle()
    callers = [threading.Thread(target=lambda: here.call("shop.work", "job", pick="least_busy")) for _ in range(9)]
    for caller in callers:
        caller.start()
        assert entered.acquire(timeout=30)
    leave.set()
    for caller in callers:
        caller.join(30)
    assert all(2 <= len(jobs) <= 4 for jobs in ran.values())


@pytest.mark.parametrize("pick", ["best", "", 5, "Any", ["any"]], ids=str)
def test_an_unknown_pick_is_a_configuration_error(here: Container, planners: Planners, pick: Any) -> None:
    calls: list[Callable[[], Any]] = [
        lambda: here.call("mind.plan", "tea", pick=pick),
        lambda: here.find("mind.plan", pick=pick),
        lambda: asyncio.run(here.acall("mind.plan", "tea", pick=pick)),
    ]
    for call in calls:
        with pytest.raises(ConfigurationError, match="pick is one of 'any', 'local', 'least_busy', 'nearest'"):
            call()
    assert counts(planners) == [0, 0, 0]


def test_a_wrong_selection_with_pick_is_a_configuration_error(here: Container, planners: Planners) -> None:
    with pytest.raises(ConfigurationError):
        here.find(Planner, pick="any")  # type: ignore[call-overload]
    with pytest.raises(errors.ConfigurationError):
        here.call(5, pick="any")  # type: ignore[arg-type]


def test_the_mark_of_calls_that_never_ran_does_not_cross_the_wire(here: Container, planners: Planners) -> None:
    [handle, *_] = here.services("mind.plan")
    planners[handle.container].raises = errors.as_never_ran(ServiceGone(service="mind.plan"), handle.key)
    failed = handle.start("tea").exception()
    assert isinstance(failed, ServiceGone)
    assert not errors.never_ran(failed, handle.key)
    wait_until(lambda: planners[handle.container].plans == ["tea"])
    assert isinstance(handle, Handle)
