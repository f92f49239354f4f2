"""The lock table by itself, against a model so naive that it is plainly right."""

import concurrent.futures
import itertools
from collections.abc import Iterable

import hypothesis
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from tests.support.waiting import wait_until
from tests.unit.trade.lock_table_rig import COUPLED, NAMES, Table
from trade._resources.grants import Granted
from trade._resources.resource import Permit
from trade.errors import LockedByOther, LockLost, MotionStopped, NotStopped
from trade.protocol.messages import Token

pytestmark = pytest.mark.virtual_time


class Model(RuleBasedStateMachine):
    """Who has what, written down as it comes; the table must agree after every step."""

    def __init__(self) -> None:
        super().__init__()
        self.real = Table()
        self.numbers = itertools.count(1)
        self.free_from: dict[str, str] = dict.fromkeys(NAMES, "")
        """Resource -> why no client gets it: its owner, who empties it, or ``!`` for one that stops."""
        self.unsafe: set[str] = set()
        self.moving: set[str] = set()
        self.queue: list[tuple[tuple[int, int], str, frozenset[str]]] = []
        self.emptying: list[tuple[str, frozenset[str]]] = []
        self.until: dict[str, float] = {}
        self.has: dict[str, frozenset[str]] = {}
        self.refused: set[str] = set()
        self.calls: dict[int, tuple[frozenset[str], Permit]] = {}
        self.asked: dict[str, concurrent.futures.Future[Granted]] = {}

    def teardown(self) -> None:
        self.real.close()
        assert all(asking.done() for asking in self.asked.values())  # every acquire ends

    # what the model thinks

    def _whole(self, names: Iterable[str]) -> frozenset[str]:
        return frozenset(itertools.chain(names, *(COUPLED.get(name, ()) for name in names)))

    def _busy(self, names: Iterable[str]) -> bool:
        used = set[str]().union(*(used for used, _ in self.calls.values()))
        return any(name in used or name in self.moving for name in names)

    def _settle(self) -> None:
        """Give on whatever can be given on."""
        changed = True
        while changed:
            changed = False
            for order, who, names in sorted(self.queue):
                earlier = [others for before, _, others in self.queue if before < order]
                if names & self.unsafe:
                    self.refused.add(who)
                elif any(self.free_from[name] for name in names) or any(names & others for others in earlier):
                    continue
                else:
                    self.emptying.append((who, names))
                    self.free_from.update(dict.fromkeys(names, who))
                self.queue.remove((order, who, names))
                changed = True
                break
            for who, names in list(self.emptying):
                if names & self.unsafe:
                    self.emptying.remove((who, names))
                    self.free_from.update(dict.fromkeys(names, ""))
                    self.refused.add(who)
                    changed = True
                elif not self._busy(names):
                    self.emptying.remove((who, names))
                    self.has[who], self.until[who] = names, self.real.now + 2.0
                    changed = True

    def _end(self, who: str) -> frozenset[str]:
        names = self.has.pop(who)
        self.until.pop(who)
        self.free_from.update(dict.fromkeys(names, ""))
        return names

    def _lose(self, who: str) -> None:
        names = self._end(who)
        self.free_from.update({name: "!" for name in names if self._busy([name])})

    def _is_pending(self, name: str, who: str) -> bool:
        pending = self.real.resources[name].pending
        return pending is not None and pending.session == who

    def _token(self, who: str) -> Token:
        token = self.asked[who].result(60).token
        assert token is not None
        return token

    # what happens

    some = st.sets(st.sampled_from(NAMES), min_size=1, max_size=3)

    @rule(names=some, priority=st.integers(0, 2))
    def ask(self, names: set[str], priority: int) -> None:
        number = next(self.numbers)
        who, whole = f"s{number}", self._whole(names)
        self.queue.append(((-priority, number), who, whole))
        self._settle()
        self.asked[who] = self.real.ask(sorted(names), who, priority=priority, lease_s=2.0)

    @rule(names=some)
    def try_it(self, names: set[str]) -> None:
        whole = self._whole(names)
        waiting = any(whole & others for _, _, others in self.queue)
        free = not waiting and not any(self.free_from[name] for name in whole) and not self._busy(whole)
        try:
            token = self.real.take(sorted(names), "try")
            assert free and not whole & self.unsafe
            self.real.table.release(token.number, "tester")
        except NotStopped:
            assert whole & self.unsafe
        except LockedByOther:
            assert not free

    @precondition(lambda self: self.has)
    @rule(data=st.data(), how=st.sampled_from(["release", "lose", "renew", "session"]))
    def owner(self, data: st.DataObject, how: str) -> None:
        who = data.draw(st.sampled_from(sorted(self.has)))
        number = self._token(who).number
        if how == "renew":
            assert self.real.table.renew([number], "tester") == [number]
            self.until[who] = self.real.now + 2.0
        elif how == "release":
            self._end(who)
            assert self.real.table.release(number, "tester")
        else:
            self._lose(who)
            if how == "lose":
                assert self.real.table.lose(number, "")
            self.real.table.session_ended(who, "")
        self._settle()

    @precondition(lambda self: self.queue or self.emptying)
    @rule(data=st.data())
    def waiter_dies(self, data: st.DataObject) -> None:
        waiting = [who for _, who, _ in self.queue] + [who for who, _ in self.emptying]
        who = data.draw(st.sampled_from(waiting))
        self.queue = [one for one in self.queue if one[1] != who]
        for gone, names in [one for one in self.emptying if one[0] == who]:
            self.emptying.remove((gone, names))
            self.free_from.update(dict.fromkeys(names, ""))
        self.refused.add(who)
        self.real.table.session_ended(who, "killed")
        self._settle()

    @rule(duration_s=st.sampled_from([0.5, 1.5, 2.0]))
    def advance(self, duration_s: float) -> None:
        for who in [who for who, until in self.until.items() if until <= self.real.now + duration_s]:
            self._lose(who)
        self.real.advance(duration_s)
        self._settle()

    @precondition(lambda self: self.real.stopping)
    @rule(problem=st.sampled_from(["", "", "no answer"]))
    def stop_ends(self, problem: str) -> None:
        resource, done = self.real.stopping.pop(0)
        self.moving.discard(resource.name)
        if problem:  # it is said before it rests: else it is a matter of timing whether a waiting client gets it
            self.unsafe.add(resource.name)
            done(resource, problem)
        resource.moving = False
        if not problem:
            done(resource, problem)
        if self.free_from[resource.name] == "!":
            self.free_from[resource.name] = ""
        self._settle()

    @precondition(lambda self: self.unsafe)
    @rule()
    def resume(self) -> None:
        for name in self.unsafe:
            self.real.resources[name].resume()
        self.unsafe.clear()
        self._settle()

    @rule(names=some, data=st.data())
    def call(self, names: set[str], data: st.DataObject) -> None:
        who = data.draw(st.sampled_from(["", *sorted(self.has)]))
        tokens = [self._token(who)] if who else []
        number = next(self.numbers)
        allowed = all(self.free_from[name] in ("", who) for name in names)
        try:
            self.calls[number] = (frozenset(names), self.real.call(sorted(names), tokens, call_id=number))
            assert allowed
        except LockedByOther:
            assert not allowed
        self._settle()

    @precondition(lambda self: self.calls)
    @rule(data=st.data(), leaves_it_moving=st.booleans())
    def call_ends(self, data: st.DataObject, leaves_it_moving: bool) -> None:
        number = data.draw(st.sampled_from(sorted(self.calls)))
        names, permitted = self.calls.pop(number)
        for name in names if leaves_it_moving else ():
            self.moving.add(name)
            self.real.resources[name].moving = True
        permitted.close()
        self._settle()

    @precondition(lambda self: self.moving)
    @rule()
    def comes_to_rest(self) -> None:
        for name in self.moving:
            self.real.resources[name].moving = False
        self.moving.clear()
        self._settle()

    # what must hold

    @invariant()
    def the_table_agrees(self) -> None:
        wait_until(lambda: {info.holder.session: frozenset(info.resources) for info in self._infos()} == self.has)
        wait_until(lambda: all(self.asked[who].done() for who in (*self.has, *self.refused)))
        assert all(self.asked[who].exception(60) for who in self.refused)
        for who, names in self.emptying:  # its thread may take its time to take its turn
            wait_until(lambda who=who, names=names: all(self._is_pending(name, who) for name in names))
        waiting = {who for _, who, _ in self.queue} | {who for who, _ in self.emptying}
        assert not any(self.asked[who].done() for who in waiting)

    @invariant()
    def a_gate_is_open_only_under_the_grant_that_holds(self) -> None:
        for names, permitted in self.calls.values():
            fences = {resource.name: live for resource, live, _ in permitted.fences}
            now = {name: self.real.resources[name].live for name in names}
            stopped = any(resource.stops != stops for resource, _, stops in permitted.fences)
            try:
                permitted.gate()
                assert fences == now
            except (LockLost, LockedByOther, MotionStopped):
                assert fences != now or stopped

    def _infos(self) -> list:
        return self.real.table.infos()


TestModel = Model.TestCase
TestModel.settings = hypothesis.settings(max_examples=150, stateful_step_count=40, deadline=None)
