"""A lease, event by event: whatever is lost, late or frozen, of two hosts one at most has the container up."""

import math
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from trade_gateway.process._kill_timer import TimerLease
from trade_gateway.supervisor._host_loads import HostLoads
from trade_gateway.supervisor._lease import Arbiter, Holder, Lease, waits_s

pytestmark = pytest.mark.virtual_time

LEASE_S = 10.0
KILL_S = 0.4
"""How long the kernel takes at most to end a process whose time is over; within the margin."""


def free(now: float = 0.0) -> Arbiter:
    """One that knows that nothing is left of the boot before."""
    made = Arbiter(["rover"], "boot")
    made.ended(now, LEASE_S)
    return made


def granted(arbiter: Arbiter, now: float, turn: str = "") -> Lease:
    assert arbiter.request(now, "rover", turn, LEASE_S)
    return Lease(arbiter.turn, LEASE_S, states=b"" if arbiter.turn == turn else b"saved")


def test_a_lease_counts_from_before_it_was_asked_for_and_its_last_third_is_for_leaving() -> None:
    holder = Holder(100.0, "base")
    assert holder.asks(100.0)
    assert not holder.held(100.0)
    holder.answered(100.0, "", Lease("a", 9.0, states=b"saved"))
    assert holder.term == TimerLease(106.0, 109.0)
    assert (holder.held(105.9), holder.held(106.0)) == (True, False)
    assert holder.states == b"saved"


def test_it_is_asked_for_again_in_time_for_several_answers_to_be_lost() -> None:
    holder, asked, now = Holder(0.0, "base"), 0, 0.0
    holder.asks(0.0)
    holder.answered(0.0, "", Lease("a", LEASE_S))
    while holder.held(now := holder.due):
        asked += holder.asks(now)
    assert asked >= 3


def test_an_old_answer_gives_neither_a_longer_lease_nor_another_state() -> None:
    holder = Holder(0.0, "base")
    holder.answered(20.0, "", Lease("a", LEASE_S, states=b"first"))
    holder.answered(10.0, "a", Lease("a", LEASE_S))
    assert holder.term.until == 30.0
    holder.answered(11.0, "", Lease("b", LEASE_S, states=b"late"))
    assert (holder.turn, holder.states) == ("a", b"first")
    holder.answered(21.0, "a", Lease("c", LEASE_S, states=b"of the arbiter"))
    assert (holder.turn, holder.states) == ("c", b"first")  # a running container continues with its own state


def test_after_a_lease_has_ended_it_begins_with_what_the_arbiter_knows() -> None:
    holder = Holder(0.0, "base")
    holder.answered(0.0, "", Lease("a", LEASE_S, states=b"first"))
    holder.asks(9.0)
    assert (holder.turn, holder.why) == ("", "base does not answer")
    holder.answered(5.0, "a", Lease("a", LEASE_S))  # a moment too late
    assert not holder.held(9.0)
    holder.answered(9.0, "", Lease("b", LEASE_S, states=b"second"))
    assert (holder.held(9.1), holder.states) == (True, b"second")


def test_a_refusal_says_why_and_ends_nothing() -> None:
    holder = Holder(0.0, "base")
    holder.answered(0.0, "", Lease("", why="base has it"))
    assert (holder.held(0.0), holder.why) == (False, "base has it")
    holder.answered(1.0, "", Lease("a", LEASE_S))
    holder.answered(0.5, "a", Lease("", why="base has it"))
    assert holder.held(2.0)


def test_a_standby_serves_once_the_last_lease_is_certainly_over() -> None:
    arbiter = free(0.0)
    assert arbiter.due == waits_s(LEASE_S)
    granted(arbiter, 5.0)
    assert not arbiter.take_if_free(arbiter.due - 0.1)
    assert arbiter.due == 5.0 + waits_s(LEASE_S) > 5.0 + LEASE_S * 1.01 / 0.99 + KILL_S
    assert arbiter.take_if_free(arbiter.due)
    assert arbiter.mine
    assert not arbiter.request(100.0, "rover", "", LEASE_S)


def test_a_standby_grants_nothing_until_leases_of_an_earlier_boot_have_ended() -> None:
    arbiter = Arbiter(["rover"], "boot")
    assert not arbiter.request(0.0, "rover", "", LEASE_S)
    assert not arbiter.take_if_free(1e6)
    arbiter.ended(7.0, LEASE_S)
    assert arbiter.request(7.0, "rover", "", LEASE_S)


def test_a_child_handed_back_returns_here_if_no_other_gateway_takes_it() -> None:
    arbiter = free(0.0)
    arbiter.take_if_free(50.0)
    arbiter.ended(51.0, LEASE_S)  # a crash is no reason to give it away
    assert arbiter.mine
    arbiter.hand_back()
    assert not arbiter.request(52.0, "rover", "", LEASE_S)  # it has not ended yet
    arbiter.ended(53.0, LEASE_S)
    assert arbiter.due == 53.0 + waits_s(LEASE_S)
    assert arbiter.request(54.0, "rover", "", LEASE_S)


def test_a_gateway_keeps_its_turn_and_gets_a_new_one_when_it_names_another() -> None:
    arbiter = free(0.0)
    first = granted(arbiter, 1.0).turn
    assert granted(arbiter, 2.0, first).turn == first
    assert granted(arbiter, 3.0).turn not in ("", first)
    arbiter.take_if_free(100.0)
    assert arbiter.turn == ""


def test_another_gateway_gets_a_lease_only_when_the_holders_is_certainly_over() -> None:
    arbiter = Arbiter(["rover", "cart"], "boot")
    arbiter.ended(0.0, LEASE_S)
    assert not arbiter.request(1.0, "cart", "", LEASE_S)  # rover may have one of an earlier boot
    assert arbiter.request(waits_s(LEASE_S), "rover", "", LEASE_S)
    first = arbiter.turn
    assert not arbiter.request(2 * waits_s(LEASE_S) - 0.1, "cart", first, LEASE_S)
    assert arbiter.request(2 * waits_s(LEASE_S), "cart", first, LEASE_S)
    assert arbiter.turn != first


def test_if_the_last_holder_is_unknown_the_others_may_ask_before_the_standby_takes_the_container() -> None:
    arbiter = Arbiter(["rover", "cart"], "boot")
    arbiter.ended(0.0, LEASE_S)
    assert not arbiter.take_if_free(waits_s(LEASE_S) + 1.0)
    assert arbiter.take_if_free(arbiter.due)


def test_after_a_restart_the_last_holder_has_its_lease_renewed_at_once() -> None:
    arbiter = Arbiter(["rover", "cart"], "boot", "cart")
    arbiter.ended(0.0, LEASE_S)
    assert not arbiter.request(0.0, "rover", "", LEASE_S)
    assert arbiter.request(0.0, "cart", "", LEASE_S)


def test_a_move_ends_the_holders_lease_and_waits_for_the_other_gateway() -> None:
    arbiter = Arbiter(["rover", "cart"], "boot", "rover")
    arbiter.ended(0.0, LEASE_S)
    turn = granted(arbiter, 0.0).turn
    arbiter.move("cart")
    assert not arbiter.request(1.0, "rover", turn, LEASE_S)
    assert not arbiter.request(1.0, "cart", "", LEASE_S)
    assert not arbiter.take_if_free(waits_s(LEASE_S))
    assert arbiter.request(waits_s(LEASE_S), "cart", "", LEASE_S)
    arbiter.move("rover")
    assert arbiter.take_if_free(arbiter.due)  # rover does not ask
    assert arbiter.due == math.inf
    arbiter.move("cart")
    assert arbiter.handing
    arbiter.ended(100.0, LEASE_S)
    assert not arbiter.request(100.0, "rover", "", LEASE_S)
    assert arbiter.request(100.0, "cart", "", LEASE_S)  # it has certainly ended here


def test_a_holder_that_is_to_leave_ends_while_its_states_are_still_saved() -> None:
    holder = Holder(0.0, "base")
    holder.answered(0.0, "", Lease("a", 9.0))
    holder.answered(1.0, "a", Lease("", why="it moves to cart", leave=True))
    assert (holder.held(1.0), holder.keeps(1.0), holder.keeps(6.0)) == (False, True, False)
    holder.answered(2.0, "a", Lease("b", 9.0))
    assert holder.held(2.0)


LOADS = {"": 0.5, "rover": 0.9, "cart": 0.1}


def choice(loads: dict[str, float], here: str = "rover", above: float = 0.8, after_s: float = 6.0) -> str | None:
    """The choice after some seconds of the same loads, which are measured every two seconds."""
    watched, chosen = HostLoads(), None
    for now in (0.0, 2.0, 4.0, after_s):
        for host, load in loads.items():
            watched.note(host, load, now)
        chosen = watched.choice(here, loads, above, now)
    return chosen


def test_a_container_moves_from_a_busy_host_to_the_least_loaded_one() -> None:
    assert choice(LOADS) == "cart"
    assert choice({**LOADS, "cart": 0.6}) == ""
    assert choice(LOADS, here="") is None
    assert choice(LOADS, above=0.95) is None
    assert choice({"": 0.85, "rover": 0.9}) is None  # nothing is gained
    assert choice({"": 0.82, "rover": 1.0}) is None  # it would be busy there, too
    assert choice(LOADS, after_s=4.5) is None  # a moment of load is none


def test_loads_that_are_old_move_nothing_and_two_moves_are_apart() -> None:
    watched = HostLoads()
    for now in range(100):
        watched.note("rover", 0.9, float(now))
        watched.note("cart", 0.1, min(float(now), 70.0))
        chosen = watched.choice("rover", ["rover", "cart"], 0.8, float(now))
        assert chosen == ("cart" if now in (5, 65) else None), now


@dataclass
class Host:
    """The host that leases: its gateway, which freezes and starts again, and its process, which the kernel ends."""

    rate: float
    holder: Holder
    lives_until: float = -math.inf
    """By its own clock; the kernel may take `KILL_S` longer."""
    frozen: bool = False


@dataclass
class Message:
    host: str
    asked_at: float
    turn: str
    boot: int
    answer: Lease | None = None


class ThreeHosts(RuleBasedStateMachine):
    """Time runs on as many clocks; messages come in any order, late, twice or never."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 1000.0
        self.questions: list[Message] = []
        self.answers: list[Message] = []
        self.boots = 0
        self.set_clocks(1.0, 1.0, 1.0)

    def set_clocks(self, rover: float, cart: float, base: float) -> None:
        self.base_rate = base
        self.hosts = {
            name: Host(rate, Holder(self.now * rate, "base")) for name, rate in (("rover", rover), ("cart", cart))
        }
        self.arbiter = Arbiter(["rover", "cart"], "boot0")
        self.written = ""
        """Who got the last lease, on the disk of base."""
        self.on_base = False
        """A process exists, whichever gateway started it."""
        self.base_frozen = False

    @property
    def at_base(self) -> float:
        return self.now * self.base_rate

    def on(self, host: Host) -> bool:
        return self.now < host.lives_until / host.rate + KILL_S

    def settle(self) -> None:
        """What both supervisors do whenever they look."""
        if not self.base_frozen:
            if not self.on_base:
                self.arbiter.ended(self.at_base, LEASE_S)
            self.arbiter.take_if_free(self.at_base)
            if self.arbiter.mine and not self.arbiter.handing:
                self.on_base = True
        for name, host in self.hosts.items():
            if not host.frozen:
                here = self.now * host.rate
                if host.holder.asks(here):
                    self.questions.append(Message(name, here, host.holder.turn, self.boots))
                if host.holder.held(here):  # started, or allowed to stay
                    host.lives_until = max(host.lives_until, host.holder.term.until)

    def request(self, message: Message) -> Lease:
        """What base answers."""
        arbiter = self.arbiter
        if not arbiter.request(self.at_base, message.host, message.turn, LEASE_S):
            return Lease("", why="base has it", leave=arbiter.holder == message.host)
        self.written = message.host
        return Lease(arbiter.turn, LEASE_S, states=b"" if arbiter.turn == message.turn else b"saved")

    clocks = st.sampled_from([0.99, 1.0, 1.01])

    names = st.sampled_from(["rover", "cart"])

    @initialize(rover=clocks, cart=clocks, base=clocks)
    def clocks_differ(self, rover: float, cart: float, base: float) -> None:
        self.set_clocks(rover, cart, base)

    @rule(s=st.sampled_from([0.05, 0.5, 1.0, 2.0, 5.0, 9.9, 11.3, 30.0]))
    def time_passes(self, s: float) -> None:
        self.now += s
        self.settle()

    @rule()
    def until_something_is_due(self) -> None:
        dues = [host.holder.due / host.rate for host in self.hosts.values()]
        due = min(*dues, self.arbiter.due / self.base_rate, self.now + 60.0)
        self.now = max(self.now, due)
        self.settle()

    @precondition(lambda self: self.questions and not self.base_frozen)
    @rule(data=st.data(), lost=st.booleans(), again=st.booleans())
    def a_question_arrives(self, data: Any, lost: bool, again: bool) -> None:
        message = data.draw(st.sampled_from(self.questions))
        if not again:
            self.questions.remove(message)
        answer = self.request(message)
        if not lost:
            self.answers.append(Message(message.host, message.asked_at, message.turn, message.boot, answer))

    @precondition(lambda self: self.answers)
    @rule(data=st.data())
    def an_answer_arrives(self, data: Any) -> None:
        message = data.draw(st.sampled_from(self.answers))
        host = self.hosts[message.host]
        if host.frozen:
            return
        self.answers.remove(message)
        if message.boot == self.boots and message.answer is not None:
            host.holder.answered(message.asked_at, message.turn, message.answer)
        self.settle()

    @rule(name=names)
    def all_is_quick_for_once(self, name: str) -> None:
        """So that leases are had in most runs."""
        host = self.hosts[name]
        if self.base_frozen or host.frozen:
            return
        self.settle()
        asked = Message(name, self.now * host.rate, host.holder.turn, self.boots)
        host.holder.answered(asked.asked_at, asked.turn, self.request(asked))
        self.settle()

    @rule(name=names)
    def a_gateway_freezes_or_thaws(self, name: str) -> None:
        self.hosts[name].frozen = not self.hosts[name].frozen
        self.settle()

    @rule()
    def the_gateway_of_base_freezes_or_thaws(self) -> None:
        self.base_frozen = not self.base_frozen
        self.settle()

    @rule(name=names)
    def a_gateway_starts_again(self, name: str) -> None:
        """The processes it left behind live at most as long as their lease."""
        self.boots += 1
        host = self.hosts[name]
        self.hosts[name] = Host(host.rate, Holder(self.now * host.rate, "base"), host.lives_until)

    @rule()
    def the_gateway_of_base_starts_again(self) -> None:
        """What it left behind may go on for any time."""
        self.boots += 1
        self.arbiter = Arbiter(["rover", "cart"], f"boot{self.boots}", self.written)
        self.base_frozen = False

    @precondition(lambda self: self.on_base and (self.arbiter.handing or not self.arbiter.mine))
    @rule()
    def what_was_on_base_has_ended(self) -> None:
        self.on_base = False
        self.settle()

    @precondition(lambda self: self.arbiter.mine)
    @rule()
    def hand_back(self) -> None:
        self.arbiter.hand_back()
        self.settle()

    @rule(to=st.sampled_from(["", "rover", "cart"]))
    def it_is_to_move(self, to: str) -> None:
        self.arbiter.move(to)
        self.settle()

    @invariant()
    def never_two(self) -> None:
        assert self.on_base + sum(self.on(host) for host in self.hosts.values()) <= 1


ThreeHosts.TestCase.settings = settings(max_examples=100, stateful_step_count=60, deadline=None)
test_never_two = ThreeHosts.TestCase
