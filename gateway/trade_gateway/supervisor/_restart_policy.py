"""The restart policy of one child: a state machine from events with their times to actions. No I/O."""

import enum
import math
from collections import deque
from typing import Final

from trade_gateway.config._children import Supervised

START_S: Final = 60.0
"""How long a child may take to start, in seconds."""
SAVE_S: Final = 6.0
"""How long saving its state before its end may take, in seconds."""
GRACE_S: Final = 20.0
"""How long its shutdown may take, in seconds: a robot is brought to rest first."""
_FIRST_S: Final = 0.05
_LONGEST_S: Final = 30.0
_DOUBLINGS: Final = 16
"""The wait before a restart doubles from the first to the longest."""


class State(enum.Enum):
    """The state of a child."""

    STOPPED = "stopped"
    """Not started yet, or ended without restart."""
    STARTING = "starting"
    UP = "up"
    SILENT = "silent"
    """Its process runs but did not answer the last health check."""
    STOPPING = "stopping"
    WAITING = "waiting"
    """It ended by itself, and is restarted after a wait; without limit if a device does not answer yet."""
    GIVEN_UP = "given up"
    """It ended by itself too often; only an explicit request restarts it."""


class Transition(enum.Enum):
    """An action for the supervisor."""

    LAUNCH = enum.auto()
    ASK = enum.auto()
    """Send a health check."""
    SAVE = enum.auto()
    """Save its state before its shutdown."""
    LEAVE = enum.auto()
    KILL = enum.auto()


class _After(enum.Enum):
    """The action that follows the end of a child."""

    STOPPED = enum.auto()
    START = enum.auto()
    FAILED = enum.auto()


_ALIVE: Final = frozenset((State.STARTING, State.UP, State.SILENT, State.STOPPING))


class ChildLife:
    """The life of one child. Times are seconds of a monotonic clock.

    Args:
        terms: its supervision; may be replaced at any time.
        grace_s: how long its shutdown may take, in seconds.
    """

    def __init__(self, terms: Supervised, *, grace_s: float = GRACE_S) -> None:
        self.terms = terms
        self.state = State.STOPPED
        self.why = ""
        """Why it ended or is being ended."""
        self.restarts = 0
        """How often it was restarted, automatically or by request."""
        self.wait_s = 0.0
        """The wait before its next restart, in seconds."""
        self.deadline = math.inf
        """When `due` is to be called."""
        self._grace_s = grace_s
        self._launched = False
        self.absences = 0
        """How many starts in a row ended since a device did not answer."""
        self._failures: deque[float] = deque()
        self._after = _After.FAILED
        self._next: deque[Transition] = deque()
        """The remaining steps to end it."""
        self._asked = -math.inf
        self._missed = 0

    @property
    def alive(self) -> bool:
        """Whether it has a process."""
        return self.state in _ALIVE

    @property
    def _was_up(self) -> bool:
        """Whether it may have a state to save."""
        return self.state in (State.UP, State.SILENT)

    # --- requests

    def start(self, now: float) -> Transition | None:
        """Starts it, also if it waits or was given up; restarts it if it runs."""
        self._failures.clear()
        if not self.alive:
            return self._launch(now)
        return self._end(now, "it is to start again", _After.START, save=self._was_up)

    def stop(self, now: float, reason: str, *, save: bool = True) -> Transition | None:
        """Ends it, with or without saving its state."""
        if self.alive:
            return self._end(now, reason, _After.STOPPED, save=save and self._was_up)
        self._rest(State.STOPPED)
        return None

    # --- events

    def up(self, now: float) -> None:
        """It is up with all its objects."""
        if self.state is State.STARTING:
            self.state, self.why, self._missed, self.absences = State.UP, "", 0, 0
            self.deadline = self._tick(now)

    def answered(self, now: float) -> None:
        """It answered the last health check."""
        if self.state in (State.UP, State.SILENT):
            self.state, self._missed = State.UP, 0
            self.deadline = self._tick(now)

    def missed(self, now: float) -> Transition | None:
        """It did not answer the last health check, or is unreachable."""
        if self.state not in (State.UP, State.SILENT):
            return None
        self.state, self._missed = State.SILENT, self._missed + 1
        if self._missed >= self.terms.misses:
            return self._end(now, self.terms.silence, _After.FAILED)
        self.deadline = max(now, self._asked + self.terms.question_s)
        return None

    def fail(self, now: float, reason: str) -> Transition | None:
        """Ends it after a serious error; it is restarted as after a crash."""
        if self.state in (State.STARTING, State.UP, State.SILENT):
            return self._end(now, reason, _After.FAILED, save=self._was_up)
        return None

    def saved(self, now: float) -> Transition | None:
        """Its state is saved, or cannot be saved."""
        if self.state is State.STOPPING and self._next and self._next[0] is Transition.LEAVE:
            return self._step(now)
        return None

    def ended(self, now: float, how: str, *, absent: bool = False) -> Transition | None:
        """Its process ended or could not be started; ``absent``: since a device does not answer, which is no crash."""
        self.absences = self.absences + 1 if absent and self.state is State.STARTING else 0
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
        """Handles the passing of `deadline`."""
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
        """Returns the time of the next health check, aligned with others so that one wake-up serves all."""
        return (math.floor(now / self.terms.question_s) + 1) * self.terms.question_s

    # --- transitions

    def _launch(self, now: float) -> Transition:
        self.restarts, self._launched = self.restarts + self._launched, True
        self.state, self.deadline = State.STARTING, now + START_S
        return Transition.LAUNCH

    def _end(self, now: float, reason: str, after: _After, *, save: bool = False) -> Transition | None:
        """Begins to end it; the last request decides what follows."""
        self.why, self._after = reason, after
        if self.state is State.STOPPING:
            return None
        self.state = State.STOPPING
        self._next = deque(
            (Transition.SAVE, Transition.LEAVE, Transition.KILL) if save else (Transition.LEAVE, Transition.KILL)
        )
        return self._step(now)

    def _step(self, now: float) -> Transition | None:
        """Takes the next step to end it, each with its time limit; the last one is SIGKILL."""
        do = self._next.popleft() if self._next else None
        took = {Transition.SAVE: SAVE_S, Transition.LEAVE: self._grace_s}
        self.deadline = math.inf if do is None else now + took.get(do, math.inf)
        return do

    def _failed(self, now: float) -> None:
        if self.terms.restart == "never":
            self._rest(State.STOPPED)
            return
        if self.absences:
            self._wait(now, self.absences)
            return
        self._failures.append(now)
        while self._failures[0] <= now - self.terms.window_s:
            self._failures.popleft()
        if len(self._failures) > self.terms.restarts:
            self._rest(State.GIVEN_UP)
            return
        self._wait(now, len(self._failures))

    def _wait(self, now: float, times: int) -> None:
        self.state = State.WAITING
        self.wait_s = min(_FIRST_S * 2 ** min(times - 1, _DOUBLINGS), _LONGEST_S)
        self.deadline = now + self.wait_s

    def _rest(self, state: State) -> None:
        self.state, self.deadline = state, math.inf
