"""A lease, event by event: whatever is lost, late or frozen, of two hosts one at most has the container up."""

import math
from dataclasses import dataclass
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from trade_gateway.process._kill_timer import TimerLease
from trade_gateway.supervisor._lease import Arbiter, Holder, Lease, waits_s

LEASE_S = 10.0
KILL_S = 0.4
"""How long the kernel takes at most to end a process whose time is over; within the margin."""


def free(now: float = 0.0) -> Arbiter:
    """One that knows that nothing is left of the boot before."""
    made = Arbiter("rover", "boot")
    made.ended(now, LEASE_S)
    return made


def granted(arbiter: Arbiter, now: float, turn: str = "") -> Lease:
    assert arbiter.asked(now, turn, LEASE_S)
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
    assert not arbiter.looked(arbiter.due - 0.1)
    assert arbiter.due == 5.0 + waits_s(LEASE_S) > 5.0 + LEASE_S * 1.01 / 0.99 + KILL_S
    assert arbiter.looked(arbiter.due)
    assert arbiter.mine
    assert not arbiter.asked(100.0, "", LEASE_S)


def test_a_standby_grants_nothing_until_leases_of_an_earlier_boot_have_ended() -> None:
    arbiter = Arbiter("rover", "boot")
    assert not arbiter.asked(0.0, "", LEASE_S)
    assert not arbiter.looked(1e6)
    arbiter.ended(7.0, LEASE_S)
    assert arbiter.asked(7.0, "", LEASE_S)


def test_a_child_handed_back_returns_here_if_no_other_gateway_takes_it() -> None:
    arbiter = free(0.0)
    arbiter.looked(50.0)
    arbiter.ended(51.0, LEASE_S)  # a crash is no reason to give it away
    assert arbiter.mine
    arbiter.hand_back()
    assert not arbiter.asked(52.0, "", LEASE_S)  # it has not ended yet
    arbiter.ended(53.0, LEASE_S)
    assert arbiter.due == 53.0 + waits_s(LEASE_S)
    assert arbiter.asked(54.0, "", LEASE_S)


def test_a_gateway_keeps_its_turn_and_gets_a_new_one_when_it_names_another() -> None:
    arbiter = free(0.0)
    first = granted(arbiter, 1.0).turn
    assert granted(arbiter, 2.0, first).turn == first
    assert granted(arbiter, 3.0).turn not in ("", first)
    arbiter.looked(100.0)
    assert arbiter.turn == ""


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
    asked_at: float
    turn: str
    boot: int
    answer: Lease | None = None


class TwoHosts(RuleBasedStateMachine):
    """Time runs on three clocks; messages come in any order, late, twice or never."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 1000.0
        self.questions: list[Message] = []
        self.answers: list[Message] = []
        self.boots = 0
        self.set_clocks(1.0, 1.0)

    def set_clocks(self, rover: float, base: float) -> None:
        self.base_rate = base
        self.host = Host(rover, Holder(self.now * rover, "base"))
        self.arbiter = Arbiter("rover", "boot0")
        self.on_base = False
        """A process exists, whichever gateway started it."""
        self.base_frozen = False

    @property
    def at_rover(self) -> float:
        return self.now * self.host.rate

    @property
    def at_base(self) -> float:
        return self.now * self.base_rate

    @property
    def on_rover(self) -> bool:
        return self.now < self.host.lives_until / self.host.rate + KILL_S

    def settle(self) -> None:
        """What both supervisors do whenever they look."""
        if not self.base_frozen:
            if not self.on_base:
                self.arbiter.ended(self.at_base, LEASE_S)
            self.arbiter.looked(self.at_base)
            if self.arbiter.mine and not self.arbiter.handing:
                self.on_base = True
        host = self.host
        if not host.frozen:
            if host.holder.asks(self.at_rover):
                self.questions.append(Message(self.at_rover, host.holder.turn, self.boots))
            if host.holder.held(self.at_rover):  # started, or allowed to stay
                host.lives_until = max(host.lives_until, host.holder.term.until)

    clocks = st.sampled_from([0.99, 1.0, 1.01])

    @initialize(rover=clocks, base=clocks)
    def clocks_differ(self, rover: float, base: float) -> None:
        self.set_clocks(rover, base)

    @rule(s=st.sampled_from([0.05, 0.5, 1.0, 2.0, 5.0, 9.9, 11.3, 30.0]))
    def time_passes(self, s: float) -> None:
        self.now += s
        self.settle()

    @rule()
    def until_something_is_due(self) -> None:
        due = min(self.host.holder.due / self.host.rate, self.arbiter.due / self.base_rate, self.now + 60.0)
        self.now = max(self.now, due)
        self.settle()

    @precondition(lambda self: self.questions and not self.base_frozen)
    @rule(data=st.data(), lost=st.booleans(), again=st.booleans())
    def a_question_arrives(self, data: Any, lost: bool, again: bool) -> None:
        message = data.draw(st.sampled_from(self.questions))
        if not again:
            self.questions.remove(message)
        arbiter = self.arbiter
        if arbiter.asked(self.at_base, message.turn, LEASE_S):
            answer = Lease(arbiter.turn, LEASE_S, states=b"" if arbiter.turn == message.turn else b"saved")
        else:
            answer = Lease("", why="base has it")
        if not lost:
            self.answers.append(Message(message.asked_at, message.turn, message.boot, answer))

    @precondition(lambda self: self.answers and not self.host.frozen)
    @rule(data=st.data())
    def an_answer_arrives(self, data: Any) -> None:
        message = data.draw(st.sampled_from(self.answers))
        self.answers.remove(message)
        if message.boot == self.boots and message.answer is not None:
            self.host.holder.answered(message.asked_at, message.turn, message.answer)
        self.settle()

    @rule()
    def all_is_quick_for_once(self) -> None:
        """So that leases are had in most runs."""
        if self.base_frozen or self.host.frozen:
            return
        self.settle()
        asked = Message(self.at_rover, self.host.holder.turn, self.boots)
        if self.arbiter.asked(self.at_base, asked.turn, LEASE_S):
            states = b"" if self.arbiter.turn == asked.turn else b"saved"
            self.host.holder.answered(asked.asked_at, asked.turn, Lease(self.arbiter.turn, LEASE_S, states=states))
        self.settle()

    @rule()
    def the_gateway_of_rover_freezes_or_thaws(self) -> None:
        self.host.frozen = not self.host.frozen
        self.settle()

    @rule()
    def the_gateway_of_base_freezes_or_thaws(self) -> None:
        self.base_frozen = not self.base_frozen
        self.settle()

    @rule()
    def the_gateway_of_rover_starts_again(self) -> None:
        """The processes it left behind live at most as long as their lease."""
        self.boots += 1
        self.host = Host(self.host.rate, Holder(self.at_rover, "base"), self.host.lives_until)

    @rule()
    def the_gateway_of_base_starts_again(self) -> None:
        """What it left behind may go on for any time."""
        self.boots += 1
        self.arbiter, self.base_frozen = Arbiter("rover", f"boot{self.boots}"), False

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

    @invariant()
    def never_two(self) -> None:
        assert not (self.on_base and self.on_rover)


TwoHosts.TestCase.settings = settings(max_examples=100, stateful_step_count=60, deadline=None)
test_never_two = TwoHosts.TestCase
