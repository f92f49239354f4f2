"""What is due is done when it is due: threads that run things at their time, against a list that is plainly right."""

import itertools
import queue
import threading

import hypothesis
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.trade.lock_table_rig import Now
from trade._threads.scheduler import MOST_THREADS, ScheduledTask, Scheduler

pytestmark = pytest.mark.virtual_time

HOUR_NS = 3_600_000_000_000
"""So far apart is all that is due: no wait of a thread ends by itself while a test runs."""


class Act:
    """Something that is begun by the scheduler, and ends when the test says so."""

    def __init__(self, model: "Model") -> None:
        self._model = model
        self._ends: queue.SimpleQueue[int | Exception | None] = queue.SimpleQueue()
        self.real: ScheduledTask
        self.began: list[int] = []
        """When, by the test's clock."""
        self.inside = 0
        self.twice_at_once = False
        # what the model thinks
        self.due: tuple[int, int] | None = None
        """When it is due, and before whom of those that are due then."""
        self.running = False
        self.asked: int | None = None
        self.cancelled = False
        self.begins: list[int] = []

    def __call__(self) -> int | None:
        self.inside += 1
        self.twice_at_once = self.twice_at_once or self.inside > 1
        self.began.append(self._model.now)
        said = self._ends.get(timeout=PATIENCE_S)
        self.inside -= 1
        if isinstance(said, Exception):
            raise said
        return said

    def end(self, again: int | Exception | None) -> None:
        """Let it return that; the scheduler has taken note of it then."""
        times = len(self.began)
        self._ends.put(again)
        wait_until(lambda: not self.real._running or len(self.began) > times)


class Model(RuleBasedStateMachine):
    """What is to run, by a look at everything that is due; so many at once and no more."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0
        self.scheduler = Scheduler("model-clock", Now(lambda: self.now))
        self.turns = itertools.count()
        self.acts: list[Act] = []

    def teardown(self) -> None:
        """Closed, it begins nothing more, and what runs ends."""
        closing = threading.Thread(target=self.scheduler.close)
        closing.start()
        wait_until(lambda: self.scheduler._closed)
        for act in self._running():
            act.end(self.now)
        closing.join(PATIENCE_S)
        assert not self.scheduler._threads
        assert [len(act.began) for act in self.acts] == [len(act.begins) for act in self.acts]

    # what the model thinks

    def _running(self) -> list[Act]:
        return [act for act in self.acts if act.running]

    def _put(self, act: Act, when: int) -> None:
        if not act.cancelled:
            act.due = (when, next(self.turns))

    def _settle(self) -> None:
        """Begin whatever can begin, first what was due first."""
        while len(self._running()) < MOST_THREADS:
            ready = [act for act in self.acts if act.due is not None and act.due[0] <= self.now]
            if not ready:
                return
            act = min(ready, key=lambda act: act.due or (0, 0))
            act.due, act.asked, act.running = None, None, True
            act.begins.append(self.now)

    def _drawn(self, data: st.DataObject, acts: list[Act]) -> Act:
        return acts[data.draw(st.integers(0, len(acts) - 1))]

    # what happens

    hours = st.integers(-2, 4)

    @rule(hours=hours, many=st.sampled_from([1, 1, 2, MOST_THREADS // 2]))
    def begin(self, hours: int, many: int) -> None:
        for _ in range(many):
            act = Act(self)
            self.acts.append(act)
            self._put(act, self.now + hours * HOUR_NS)
            act.real = self.scheduler.begin(act, self.now + hours * HOUR_NS)
        self._settle()

    @precondition(lambda self: self.acts)
    @rule(data=st.data(), hours=hours)
    def at(self, data: st.DataObject, hours: int) -> None:
        """Another time for what is due, or once more for what runs."""
        act, when = self._drawn(data, self.acts), self.now + hours * HOUR_NS
        if act.running:
            act.asked = when
        else:
            self._put(act, when)
        self._settle()
        act.real.at(when)

    @precondition(lambda self: self.acts)
    @rule(data=st.data(), hours=hours)
    def by(self, data: st.DataObject, hours: int) -> None:
        """The same, if that is sooner."""
        act, when = self._drawn(data, self.acts), self.now + hours * HOUR_NS
        if act.running:
            act.asked = when if act.asked is None else min(act.asked, when)
        elif act.due is None or when < act.due[0]:
            self._put(act, when)
        self._settle()
        act.real.by(when)

    @precondition(lambda self: self.acts)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        act = self._drawn(data, self.acts)
        act.cancelled, act.due = True, None
        act.real.cancel()

    @precondition(lambda self: self._running())
    @rule(data=st.data(), how=st.one_of(st.none(), hours, st.just("raises")))
    def end(self, data: st.DataObject, how: int | str | None) -> None:
        act = self._drawn(data, self._running())
        again = self.now + how * HOUR_NS if isinstance(how, int) else None
        wanted = [when for when in (again, act.asked) if when is not None]
        act.running = False
        if wanted:
            self._put(act, min(wanted))
        self._settle()
        act.end(OSError("the cable is off") if how == "raises" else again)

    @rule(hours=st.integers(1, 3))
    def advance(self, hours: int) -> None:
        self.now += hours * HOUR_NS
        self._settle()
        with self.scheduler._lock:
            self.scheduler._sooner.notify_all()

    # what must hold

    @invariant()
    def each_began_when_it_was_due_and_as_often(self) -> None:
        wait_until(lambda: all(len(act.began) >= len(act.begins) for act in self.acts))
        assert [act.began for act in self.acts] == [act.begins for act in self.acts]
        assert [act.inside for act in self.acts] == [int(act.running) for act in self.acts]
        assert not any(act.twice_at_once for act in self.acts)


def test_a_task_that_is_alone_needs_one_thread_however_often_it_runs() -> None:
    scheduler, runs = Scheduler("model-clock"), list[str]()

    def act() -> int | None:
        runs.append(threading.current_thread().name)
        return 0 if len(runs) < 10 else None

    scheduler.begin(act, 0)
    wait_until(lambda: len(runs) == 10)
    assert [thread.name for thread in scheduler._threads] == ["model-clock-0"]
    scheduler.close()


def test_a_task_wanted_by_two_times_while_it_runs_runs_by_the_sooner_one() -> None:
    scheduler, began, may_end = Scheduler("model-clock"), threading.Event(), threading.Event()

    def act() -> None:
        began.set()
        may_end.wait(PATIENCE_S)

    task = scheduler.begin(act, 0)
    assert began.wait(PATIENCE_S)
    for when in (2**61, 2**60, 2**62):
        task.by(when)
    may_end.set()
    wait_until(lambda: task.next_ns == 2**60)
    scheduler.close()


def test_a_cancelled_task_is_waited_for_only_as_long_as_was_said_and_not_by_itself() -> None:
    scheduler, began, may_end = Scheduler("model-clock"), threading.Event(), threading.Event()

    def act() -> None:
        began.set()
        may_end.wait(PATIENCE_S)
        task.cancel(PATIENCE_S)

    task = scheduler.begin(act, 0)
    assert began.wait(PATIENCE_S)
    task.cancel(0.01)
    assert task._running
    scheduler.close()  # does not wait for it once more
    assert task._running
    may_end.set()
    task.cancel(PATIENCE_S)
    assert not task._running


TestModel = Model.TestCase
TestModel.settings = hypothesis.settings(max_examples=30, stateful_step_count=30, deadline=None)


def _refuse(monkeypatch: pytest.MonkeyPatch) -> None:
    start = threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if thread.name.startswith("few-clock"):
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", refuse)


def test_a_task_due_while_no_thread_can_start_runs_with_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler, first, second = Scheduler("few-clock"), threading.Event(), threading.Event()
    with monkeypatch.context() as few:
        _refuse(few)
        scheduler.begin(first.set, 0)
        assert not first.is_set()
    scheduler.begin(second.set, 0)
    assert first.wait(PATIENCE_S)
    assert second.wait(PATIENCE_S)
    scheduler.close()


def test_a_single_thread_runs_tasks_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler = Scheduler("few-clock")
    scheduler.begin(lambda: None, 2**62)
    wait_until(lambda: scheduler._leading)
    _refuse(monkeypatch)
    for _ in range(2):
        done = threading.Event()
        scheduler.begin(done.set, 0)
        assert done.wait(PATIENCE_S)
    scheduler.close()
