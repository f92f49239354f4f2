"""Helpers of the contracts: refusals, waits with a deadline, calls in threads, streams, short motions."""

# ruff: noqa: S101 - these are tests

import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, Final, Generic, TypeVar

from trade import where
from trade.errors import TradeError
from trade.testing import memory_system
from trade_drivers.interfaces._motion import MotorState
from trade_drivers.motion._plan import JointLimits

REACH_RAD: Final = 0.12
"""The maximum distance of a joint from its initial position."""
SPEED_RAD_S: Final = 0.2
"""The maximum speed."""
NEAR_RAD: Final = 0.03
"""The required distance to a goal."""
_PATIENCE_S: Final = 20.0

_Result = TypeVar("_Result")


@contextmanager
def refused(error: type[TradeError]) -> Generator[None, None, None]:
    """Requires that the block is refused with this error."""
    try:
        yield
    except error:
        return
    raise AssertionError(f"it was not refused with {error.__name__}")


def until(true: Callable[[], object], what: str) -> None:
    """Waits for a condition, and fails after a time."""
    deadline = time.monotonic() + _PATIENCE_S
    while not true():
        assert time.monotonic() < deadline, f"waited {_PATIENCE_S:g} s in vain until {what}"
        threading.Event().wait(0.005)


class Caller(Generic[_Result]):
    """A long call in a thread of its own."""

    def __init__(self, act: Callable[[], _Result]) -> None:
        self._act = act
        self._error: TradeError | None = None
        self._results: list[_Result] = []
        self._thread = threading.Thread(target=self._run, name="caller", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._results.append(self._act())
        except TradeError as error:
            self._error = error

    def error(self) -> TradeError | None:
        """Waits for the end of the call, and returns its error."""
        self._thread.join(_PATIENCE_S)
        assert not self._thread.is_alive(), "the call does not end"
        return self._error

    def result(self) -> _Result:
        """Waits for the end of the call, and returns its result or raises its error."""
        if (error := self.error()) is not None:
            raise error
        return self._results[0]


def at_once(act: Callable[[], _Result], callers: int) -> list[_Result]:
    """Returns the results of several simultaneous calls."""
    return [caller.result() for caller in [Caller(act) for _ in range(callers)]]


def streamed(provider: object, group: str, service: str) -> tuple[Any, Any]:
    """Returns two samples of a service as another container receives them."""
    with memory_system() as system:
        driver, listener = system.container("driver"), system.container("listener")
        driver.register(provider, group)
        system.settle()
        with listener.stream(where(name=service, group=group), hz=20) as stream:
            first, second = stream.next(_PATIENCE_S), stream.next(_PATIENCE_S)
        driver.deregister(provider)
    return first.value, second.value


def ahead(states: Sequence[MotorState], limits: Sequence[JointLimits], part: float = 1.0) -> list[float]:
    """Returns a short motion from the joints' positions, to the side with more room."""
    goals: list[float] = []
    for state, limit in zip(states, limits, strict=True):
        up, down = limit.max_rad - state.position_rad, state.position_rad - limit.min_rad
        way = min(REACH_RAD, max(up, down)) * part
        goals.append(state.position_rad + (way if up >= down else -way))
    return goals
