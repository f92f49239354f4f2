"""What goes out next on a bus, whatever is on it: jobs in turn, stops before everything, an end for all who wait."""

import itertools
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import hypothesis
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

from tests.support.waiting import PATIENCE_S
from trade import Resource
from trade.errors import BusGone, DeviceFault, DeviceSilent, TradeError
from trade_drivers.bus._cycle import HALT_NS, BusCycle, StopTicket, _drained
from trade_drivers.bus._jobs import AwaitedJob, Device, Steps

MS = 1_000_000
PERIOD_NS = 10 * MS
EXCHANGE_NS = 2 * MS
STALE_NS = 100 * MS


class Joint:
    """What the exchange knows of a device."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.bus = "/dev/model"
        self.resource = Resource(name)
        self.halting_since_ns = self.misses = self.silent_since_ns = self.probe_at_ns = self.heard_ns = 0
        self.doubted = self.silent = self.deafened = False
        self.fault = self.unheld = ""

    def age_ns(self, now_ns: int) -> int:
        return now_ns - self.heard_ns

    def silent_error(self, now_ns: int) -> DeviceSilent:
        return DeviceSilent(device=self.name, bus=self.bus, waited_s=self.age_ns(now_ns) / 1e9)

    def fault_error(self, fault: str = "") -> DeviceFault:
        return DeviceFault(device=self.name, bus=self.bus, fault=fault or self.fault)


class Exchange(BusCycle[Joint]):
    """The least there can be on a bus: stops, work, and what became of the stops."""

    def cycle(self) -> None:
        began_ns = self.clock()
        self.serve_stops()
        self.work(began_ns + self.period_ns // 2)
        self.answer_stops(self.clock())

    def halt_all(self, reason: str) -> None: ...

    def fail_motion(self, device: Joint, error_of: Callable[[Device], TradeError]) -> None: ...

    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None: ...


class Job(AwaitedJob[Joint]):
    """So many exchanges with its joints, of which the last may fail."""

    def __init__(self, model: "Model", number: int, joints: Sequence[Joint], exchanges: int, fails: bool) -> None:
        super().__init__(joints)
        self.number = number
        self._model = model
        self._exchanges = exchanges
        self._fails = fails

    def step(self) -> bool:
        self._model.turn_of(self)
        return super().step()

    def steps(self) -> Steps:
        for left in reversed(range(self._exchanges)):
            self._model.exchanged()
            if self._fails and not left:
                raise self.devices[0].silent_error(self._model.now)
            yield


def became_of(work: AwaitedJob[Joint]) -> type[TradeError] | None:
    try:
        work.wait(lambda: True)
    except TradeError as error:
        return type(error)
    return None


class Model(RuleBasedStateMachine):
    """Who has been taken on, in order, and the rules of turns; the exchange must keep them with every step."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0
        self.numbers = itertools.count(1)
        self.joints = [Joint(name) for name in "abc"]
        bus = SimpleNamespace(rate_hz=1e9 / PERIOD_NS, stale_after_s=STALE_NS / 1e9, watchdog_s=0.3)
        self.exchange = Exchange(bus, self.joints, lambda: self.now)  # type: ignore[arg-type]
        self.jobs: list[Job] = []
        """In the order in which they were taken on; those that ended, too."""
        self.turns: Counter[int] = Counter()
        """Of jobs in this cycle."""
        self.unwritten: list[int] = []
        """Stops that have come and are not on the wire yet."""
        self.waiting: list[StopTicket[Joint]] = []
        """Stops that are on the wire, while it is not known what comes of them."""
        self.tickets: dict[int, StopTicket[Joint]] = {}
        self.meanwhile: list[list[Joint]] = []
        """Stops that come while the next exchanges are under way."""
        self.stopped = False
        """Whether one came in this cycle."""

    def teardown(self) -> None:
        """Nothing starves: with time, everything that was taken on ends."""
        self._back()
        for _ in range(2 * sum(job._exchanges + 1 for job in self.jobs) + 2):
            self._cycle()
            for joint in self.joints:
                joint.silent, joint.halting_since_ns = False, 0
        assert all(job.ended for job in self.jobs)
        assert all(ticket.ended for ticket in self.tickets.values())

    def turn_of(self, job: Job) -> None:
        """Before one shares a device with an earlier one, that one has ended."""
        earlier = self.jobs[: self.jobs.index(job)]
        assert not [other.number for other in earlier if not other.ended and set(other.devices) & set(job.devices)]
        assert not job.ended
        self.turns[job.number] += 1

    def exchanged(self) -> None:
        """One exchange of a job is over: there was no stop to be written instead."""
        assert not self.unwritten
        self.now += EXCHANGE_NS
        if self.meanwhile:
            self._stop(self.meanwhile.pop(0))

    def halted(self, number: int, joints: Sequence[Joint]) -> None:
        """A stop goes out: each once, in the order they came."""
        assert self.unwritten.pop(0) == number
        for joint in joints:
            joint.halting_since_ns = joint.halting_since_ns or self.now or 1
        if not self.tickets[number].ended:
            self.waiting.append(self.tickets[number])

    def _stop(self, joints: list[Joint]) -> None:
        number = next(self.numbers)
        self.unwritten.append(number)
        self.stopped = True
        stops = [joint.resource.stops for joint in joints]
        ticket = self.exchange.order_stop(joints, "the test said so", lambda: self.halted(number, joints))
        self.tickets[number] = ticket
        assert all(joint.resource.stops != before for joint, before in zip(joints, stops, strict=True))  # void at once
        assert ticket.ended == (self.exchange.refusing is not None)

    some = st.sets(st.integers(0, 2), min_size=1)

    def _of(self, places: set[int]) -> list[Joint]:
        return [self.joints[place] for place in sorted(places)]

    job = st.tuples(some, st.integers(1, 5), st.booleans())

    @rule(jobs=st.lists(job, min_size=1, max_size=4))
    def submit(self, jobs: list[tuple[set[int], int, bool]]) -> None:
        for places, exchanges, fails in jobs:
            job = Job(self, next(self.numbers), self._of(places), exchanges, fails)
            self.exchange.submit(job)
            if self.exchange.refusing is not None:
                assert became_of(job) is BusGone
            else:
                self.jobs.append(job)

    @rule(places=some)
    def stop(self, places: set[int]) -> None:
        self._stop(self._of(places))

    @rule(places=some)
    def stop_during_an_exchange(self, places: set[int]) -> None:
        self.meanwhile.append(self._of(places))

    @precondition(lambda self: self.exchange.refusing is None)
    @rule()
    def cycle(self) -> None:
        self._cycle()

    def _cycle(self) -> None:
        for joint in self.joints:
            if not joint.deafened:
                joint.heard_ns = self.now
        open_jobs = [job for job in self.jobs if not job.ended]
        first = [job for job in open_jobs if self._is_first(job, open_jobs)]
        waited = list(self.waiting)
        self.turns.clear()
        self.stopped = False
        self.exchange.cycle()
        if first:
            assert self.turns[first[0].number] >= 1
        if not self.stopped:
            assert all(self.turns[job.number] >= 1 for job in first)
            lasting = [self.turns[job.number] for job in first if not job.ended]
            assert not lasting or max(lasting) - min(lasting) <= 1  # an exchange of each in turn
        self._judge_stops([*waited, *(ticket for ticket in self.waiting if ticket not in waited)])
        self.now += PERIOD_NS

    def _is_first(self, job: Job, jobs: Sequence[Job]) -> bool:
        earlier = jobs[: jobs.index(job)]
        return not any(set(other.devices) & set(job.devices) for other in earlier)

    def _judge_stops(self, tickets: Sequence[StopTicket[Joint]]) -> None:
        """Who waits for a stop hears when all joints rest, or which of them is not heard, or does not come to rest."""
        for ticket in tickets:
            unheard = [joint for joint in ticket.devices if joint.silent or joint.age_ns(self.now) > STALE_NS]
            halting = [joint for joint in ticket.devices if joint.halting_since_ns and joint not in unheard]
            too_long = [joint for joint in halting if self.now - joint.halting_since_ns > HALT_NS]
            over = halting == too_long
            assert ticket.ended == over
            if over:
                self.waiting.remove(ticket)
                kinds = {DeviceSilent} if unheard else set()
                kinds |= {DeviceFault} if too_long else set()
                assert became_of(ticket) in (kinds or {None})

    @rule()
    def rest(self) -> None:
        """What comes between two cycles; also while nothing is taken on."""
        self.exchange.idle(0.0)
        assert not self.unwritten

    @rule(place=st.integers(0, 2), what=st.sampled_from(["rests", "rests", "deaf", "left out", "heard again"]))
    def joint(self, place: int, what: str) -> None:
        joint = self.joints[place]
        if what == "rests":
            joint.halting_since_ns = 0
        elif what == "heard again":
            joint.deafened = joint.silent = False
        else:
            joint.deafened, joint.silent = True, what == "left out"

    @rule(duration_ns=st.sampled_from([PERIOD_NS, 2 * STALE_NS, HALT_NS + PERIOD_NS]))
    def advance(self, duration_ns: int) -> None:
        self.now += duration_ns

    @precondition(lambda self: self.exchange.refusing is None)
    @rule()
    def the_port_goes(self) -> None:
        def gone(device: Device) -> TradeError:
            return BusGone(device=device.name, bus="/dev/model", waited_s=0.0)

        open_now = [*(job for job in self.jobs if not job.ended), *self.waiting]
        open_now += [self.tickets[number] for number in self.unwritten if not self.tickets[number].ended]
        self.exchange.refusing = gone
        self.exchange.fail_all(gone)
        assert all(became_of(one) is BusGone for one in open_now)
        self.waiting.clear()
        self.unwritten.clear()

    @precondition(lambda self: self.exchange.refusing is not None)
    @rule()
    def the_port_is_back(self) -> None:
        self._back()

    def _back(self) -> None:
        self.exchange.refusing = None


TestModel = Model.TestCase
TestModel.settings = hypothesis.settings(max_examples=60, stateful_step_count=40, deadline=None)


def test_a_job_submitted_while_all_are_ended_is_ended_or_still_pending() -> None:
    """Else a service would wait for a lost job."""
    inbox: deque[int] = deque()
    many = 200_000
    handing_in = threading.Thread(target=lambda: [inbox.append(number) for number in range(many)])
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        handing_in.start()
        ended: list[int] = []
        while handing_in.is_alive():
            ended += _drained(inbox)
        handing_in.join(PATIENCE_S)
    finally:
        sys.setswitchinterval(before)
    assert [*ended, *inbox] == list(range(many))


@pytest.mark.virtual_time
def test_S07_a_stop_that_comes_when_the_stops_were_just_served_does_not_wait_for_the_next_cycle() -> None:
    joint, halted = Joint("a"), list[tuple[str, float]]()

    class Interrupted(Exchange):
        def serve_stops(self) -> None:
            super().serve_stops()
            if len(halted) == 1:  # here another thread may run
                self.order_stop([joint], "second", lambda: halted.append(("second", time.monotonic())))

    bus = SimpleNamespace(rate_hz=1e9 / PERIOD_NS, stale_after_s=STALE_NS / 1e9, watchdog_s=0.3)
    exchange = Interrupted(bus, [joint])  # type: ignore[arg-type]
    began = time.monotonic()
    exchange.order_stop([joint], "first", lambda: halted.append(("first", time.monotonic())))
    exchange.idle(10.0)
    exchange.idle(10.0)
    assert [name for name, _ in halted] == ["first", "second"]
    assert halted[-1][1] - began < 0.05
