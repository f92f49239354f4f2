"""The restart policy of one child as a state machine: it gets events with their times and says what to do. No I/O."""

import enum
import math
from collections import deque
from typing import Final

from trade_gateway.config._children import Supervised

__all__ = ["GRACE_S", "Life", "State", "Transition"]

START_S: Final = 60.0
"""How long it may take from its first instruction until it is up."""
SAVE_S: Final = 6.0
"""How long the state of one that is to end may take to be saved."""
GRACE_S: Final = 20.0
"""How long it may take to leave: a robot is brought to rest before."""
_FIRST_S: Final = 0.1
_LONGEST_S: Final = 30.0
"""The wait before it is started again doubles from the one to the other."""


class State(enum.Enum):
    """Where a child stands."""

    STOPPED = "stopped"
    """Not started yet, or ended and not to be started again."""
    STARTING = "starting"
    UP = "up"
    SILENT = "silent"
    """Its process lives and has left a question unanswered."""
    STOPPING = "stopping"
    WAITING = "waiting"
    """It ended unasked, and is started again after a while."""
    GIVEN_UP = "given up"
    """It ended unasked too often; only somebody who asks for it starts it again."""


class Transition(enum.Enum):
    """What is to be done now."""

    LAUNCH = enum.auto()
    ASK = enum.auto()
    """Whether it answers."""
    SAVE = enum.auto()
    """Its state, before it is told to leave."""
    LEAVE = enum.auto()
    KILL = enum.auto()


class _After(enum.Enum):
    """What its end means."""

    STOPPED = enum.auto()
    START = enum.auto()
    FAILED = enum.auto()


_ALIVE: Final = frozenset((State.STARTING, State.UP, State.SILENT, State.STOPPING))


class Life:
    """One child. Times are seconds of a clock that never jumps.

    Args:
        terms: how it is looked after; may be replaced at any time.
        grace_s: how long it may take to leave.
    """

    def __init__(self, terms: Supervised, *, grace_s: float = GRACE_S) -> None:
        self.terms = terms
        self.state = State.STOPPED
        self.why = ""
        """Why it is ended, or has ended."""
        self.restarts = 0
        """How often it was started again, by itself or because somebody asked."""
        self.wait_s = 0.0
        """How long it waits until it is started again, once it waits."""
        self.deadline = math.inf
        """When `due` is to be called."""
        self._grace_s = grace_s
        self._launched = False
        self._failures: deque[float] = deque()
        self._after = _After.FAILED
        self._next: deque[Transition] = deque()
        """What is still to be tried to end it."""
        self._asked = -math.inf
        self._missed = 0

    @property
    def alive(self) -> bool:
        """Whether it has a process."""
        return self.state in _ALIVE

    @property
    def _was_up(self) -> bool:
        """Whether there may be a state to save, though it may not be told any more."""
        return self.state in (State.UP, State.SILENT)

    # --- told by who wants it up or down

    def start(self, now: float) -> Transition | None:
        """It is wanted: at once if it waits or was given up, again if it runs."""
        self._failures.clear()
        if not self.alive:
            return self._launch(now)
        return self._end(now, "it is to start again", _After.START, save=self._was_up)

    def stop(self, now: float, why: str, *, save: bool = True) -> Transition | None:
        """It is not wanted any more; its state may be worth nothing any more, either."""
        if self.alive:
            return self._end(now, why, _After.STOPPED, save=save and self._was_up)
        self._rest(State.STOPPED)
        return None

    # --- told by who watches it

    def up(self, now: float) -> None:
        """All that it is to have in it is there."""
        if self.state is State.STARTING:
            self.state, self.why, self._missed = State.UP, "", 0
            self.deadline = self._tick(now)

    def answered(self, now: float) -> None:
        """It has answered the question asked last."""
        if self.state in (State.UP, State.SILENT):
            self.state, self._missed = State.UP, 0
            self.deadline = self._tick(now)

    def missed(self, now: float) -> Transition | None:
        """It has not answered the question asked last, or cannot be reached."""
        if self.state not in (State.UP, State.SILENT):
            return None
        self.state, self._missed = State.SILENT, self._missed + 1
        if self._missed >= self.terms.misses:
            return self._end(now, f"it did not answer within {self.terms.answers_within_s:g} s", _After.FAILED)
        self.deadline = max(now, self._asked + self.terms.question_s)
        return None

    def fail(self, now: float, why: str) -> Transition | None:
        """Something is so wrong with it that it has to go; it is started again as after a crash."""
        if self.state in (State.STARTING, State.UP, State.SILENT):
            return self._end(now, why, _After.FAILED, save=self._was_up)
        return None

    def saved(self, now: float) -> Transition | None:
        """Its state is saved, or cannot be."""
        if self.state is State.STOPPING and self._next and self._next[0] is Transition.LEAVE:
            return self._step(now)
        return None

    def ended(self, now: float, how: str) -> Transition | None:
        """It has no process any more, or could not be given one."""
        after = self._after if self.state is State.STOPPING else _After.FAILED
        if self.state is not State.STOPPING:
            self.why = how
        elif after is _After.FAILED:
            self.why = f"{self.why}; it {how}"
        match after:
            case _After.STOPPED:
                self._rest(State.STOPPED)
            case _After.START:
                return self._launch(now)
            case _After.FAILED:
                self._failed(now)
        return None

    def due(self, now: float) -> Transition | None:
        """`deadline` has passed."""
        match self.state:
            case State.STARTING:
                return self._end(now, f"it was not up within {START_S:g} s", _After.FAILED)
            case State.UP | State.SILENT:
                self._asked, self.deadline = now, math.inf
                return Transition.ASK
            case State.STOPPING:
                return self._step(now)
            case State.WAITING:
                return self._launch(now)
            case State.STOPPED | State.GIVEN_UP:
                self.deadline = math.inf
                return None

    def _tick(self, now: float) -> float:
        """When to ask it next: at the same moments as others of its terms, so that one wake does for all."""
        return (math.floor(now / self.terms.question_s) + 1) * self.terms.question_s

    # --- going on

    def _launch(self, now: float) -> Transition:
        self.restarts, self._launched = self.restarts + self._launched, True
        self.state, self.deadline = State.STARTING, now + START_S
        return Transition.LAUNCH

    def _end(self, now: float, why: str, after: _After, *, save: bool = False) -> Transition | None:
        """Have it end; what it means that it has ended is for who asks last to say."""
        self.why, self._after = why, after
        if self.state is State.STOPPING:
            return None
        self.state = State.STOPPING
        self._next = deque(
            (Transition.SAVE, Transition.LEAVE, Transition.KILL) if save else (Transition.LEAVE, Transition.KILL)
        )
        return self._step(now)

    def _step(self, now: float) -> Transition | None:
        """The next way to end it; each has its time. One that is killed and does not end is beyond help."""
        do = self._next.popleft() if self._next else None
        took = {Transition.SAVE: SAVE_S, Transition.LEAVE: self._grace_s}
        self.deadline = math.inf if do is None else now + took.get(do, math.inf)
        return do

    def _failed(self, now: float) -> None:
        if self.terms.restart == "never":
            self._rest(State.STOPPED)
            return
        self._failures.append(now)
        while self._failures[0] <= now - self.terms.window_s:
            self._failures.popleft()
        if len(self._failures) > self.terms.restarts:
            self._rest(State.GIVEN_UP)
            return
        self.state = State.WAITING
        self.wait_s = min(_FIRST_S * 2 ** (len(self._failures) - 1), _LONGEST_S)
        self.deadline = now + self.wait_s

    def _rest(self, state: State) -> None:
        self.state, self.deadline = state, math.inf
