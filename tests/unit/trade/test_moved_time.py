"""The time that `advance` moves: deadlines, notifications, lock waits and lock leases, without a wait of the test."""

import threading
from collections.abc import Iterator
from contextvars import copy_context
from datetime import datetime, timedelta, timezone

import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, Resource, service
from trade.errors import LockedByOther, LockLost, OutcomeUnknown
from trade.testing import MemorySystem, memory_system

pytestmark = pytest.mark.virtual_time

LONG_S = 600.0


class Axis:
    def __init__(self) -> None:
        self.resources = [Resource("axis")]
        self.looks = 0
        self.arrived = threading.Event()

    @service
    def move(self) -> None:
        assert self.arrived.wait(60)
        threading.Event().wait(0.05)  # real work, for which the moved time waits

    @service(effect="stop")
    def stop(self) -> None: ...

    @service(effect="read")
    def look(self) -> None:
        self.looks += 1


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system() as made:
        yield made


@pytest.fixture
def axis(system: MemorySystem) -> Axis:
    made = Axis()
    system.container("robot").register(made, "axis")
    return made


@pytest.fixture
def look(system: MemorySystem, axis: Axis) -> Handle:
    return system.container("me").find("axis.look")


@pytest.fixture
def me(system: MemorySystem) -> Container:
    return system.container("me")


def test_every_runs_once_for_each_period(system: MemorySystem, me: Container, axis: Axis, look: Handle) -> None:
    noted = me.every(10, look)
    system.advance(9.5)
    assert axis.looks == 0
    for count in range(1, 6):
        system.advance(10)
        assert axis.looks == count
    system.advance(100)
    assert axis.looks == 15
    noted.cancel()
    system.advance(100)
    assert axis.looks == 15
    assert noted.info().merged == 0


@pytest.mark.real_clock
def test_after_and_at_run_once_when_their_time_comes(
    system: MemorySystem, me: Container, axis: Axis, look: Handle
) -> None:
    me.after(LONG_S, look)
    me.at(datetime.now(timezone.utc) + timedelta(seconds=2 * LONG_S), look)
    system.advance(LONG_S - 60)
    assert axis.looks == 0
    system.advance(120)
    assert axis.looks == 1
    system.advance(LONG_S - 180)
    assert axis.looks == 1
    system.advance(120)
    assert axis.looks == 2
    system.advance(10 * LONG_S)
    assert axis.looks == 2


def test_actions_run_in_order_of_their_times(system: MemorySystem, me: Container) -> None:
    ran: list[float] = []
    for delay_s in (30.0, 10.0, 20.0):
        me.after(delay_s, lambda delay_s=delay_s: ran.append(delay_s))
    system.advance(25)
    assert ran == [10.0, 20.0]
    system.advance(10)
    assert ran == [10.0, 20.0, 30.0]


class Asking:
    """A client that waits for a lock, on a thread."""

    def __init__(self, container: Container, wait_s: float) -> None:
        self._lock = container.lock("axis", wait_s=wait_s)
        self.refused: LockedByOther | None = None
        self._thread = threading.Thread(target=self._ask)
        self._thread.start()
        wait_until(lambda: any(info.waiting for info in container.locks()))

    def _ask(self) -> None:
        try:
            self._lock.acquire()
        except LockedByOther as refused:
            self.refused = refused
        else:
            self._lock.release()

    @property
    def waits(self) -> bool:
        return self._thread.is_alive()

    def end(self) -> None:
        self._thread.join(60)
        assert not self.waits


def test_a_lock_wait_ends_when_its_time_is_over(system: MemorySystem, me: Container, axis: Axis) -> None:
    with me.lock("axis"):
        asking = Asking(system.container("other"), LONG_S)
        system.advance(LONG_S - 10)
        assert asking.waits
        system.advance(20)
        asking.end()
    assert asking.refused is not None


def test_a_lock_wait_ends_with_the_lock(system: MemorySystem, me: Container, axis: Axis) -> None:
    with me.lock("axis"):
        asking = Asking(system.container("other"), LONG_S)
        system.advance(60)
    asking.end()
    assert asking.refused is None


def test_a_lock_whose_owner_lives_is_renewed_all_the_time(system: MemorySystem, me: Container, axis: Axis) -> None:
    with me.lock("axis", lease_s=1.0) as lock:
        for _ in range(5):
            system.advance(60)
            lock.check()
        assert [info.resources for info in me.locks()] == [("axis",)]


def test_S12_a_lease_ends_on_both_sides_when_it_cannot_be_renewed() -> None:
    with memory_system(lease_s=LONG_S) as system:  # the link is slower to notice
        system.container("robot").register(Axis(), "axis")
        me = system.container("me")
        lock = me.lock("axis", lease_s=5.0).acquire()
        system.partition("me", "robot")
        system.advance(3)
        lock.check()
        system.advance(4)
        with pytest.raises(LockLost, match="its lease"):
            lock.check()
        other = system.container("other")
        with other.lock("axis", wait_s=10):
            pass


@pytest.fixture
def move(system: MemorySystem, me: Container, axis: Axis) -> Iterator[Handle]:
    with me.lock("axis"):
        yield me.find("axis.move")
        axis.arrived.set()


def test_a_started_call_ends_at_its_deadline(system: MemorySystem, move: Handle) -> None:
    system.advance(LONG_S)  # before the call begins
    run = move.with_(deadline_s=LONG_S).start()
    system.advance(LONG_S - 10)
    assert not run.done()
    system.advance(20)
    assert isinstance(run.exception(0), OutcomeUnknown)


def test_a_call_that_a_thread_waits_for_ends_at_its_deadline(system: MemorySystem, move: Handle, me: Container) -> None:
    failed: list[Exception] = []

    def wait() -> None:
        try:
            move.with_(deadline_s=LONG_S)()
        except OutcomeUnknown as late:
            failed.append(late)

    waiting = threading.Thread(target=copy_context().run, args=(wait,))
    waiting.start()
    wait_until(lambda: any(info.uses for info in me.locks()))
    system.advance(LONG_S - 10)
    assert not failed
    system.advance(20)
    waiting.join(60)
    assert len(failed) == 1


def test_a_call_whose_work_is_done_before_its_deadline_is_not_late(
    system: MemorySystem, me: Container, axis: Axis, move: Handle
) -> None:
    me.after(LONG_S, axis.arrived.set)
    run = move.with_(deadline_s=LONG_S + 0.5).start()
    system.advance(2 * LONG_S)
    assert run.exception(60) is None


def test_another_system_keeps_its_time(system: MemorySystem, me: Container, axis: Axis, look: Handle) -> None:
    me.every(10, look)
    with memory_system() as other:
        other.container("me")
        other.advance(LONG_S)
    system.settle()
    assert axis.looks == 0
