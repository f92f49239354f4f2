"""The work of e-stops that must not delay the receiving thread: one shared thread, while there is work."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from msgspec import Struct

from trade._estop.deadman import Deadman
from trade._resources.resource import Resource
from trade.protocol.messages import Estop

_logger = logging.getLogger("trade")

_ANSWER_S: Final = 2.5
"""When a container reports what did not come to rest; a stop service that does not return is reported after 2 s."""
SHARED_S: Final = 0.1
"""An e-stop within this time after another one shares its stops; repeated orders keep this interval, too."""


class Round:
    """One round of all stops here, shared by all e-stops that arrive at about the same time."""

    def __init__(self, resources: Callable[[], Sequence[Resource]]) -> None:
        self._resources = resources
        self._begun = time.monotonic()
        self._problems: Sequence[str] | None = None

    def begin(self, deadman: Deadman) -> None:
        """Begins the stops; does not wait."""
        deadman.everything(self._ended)

    def _ended(self, problems: Sequence[str]) -> None:
        self._problems = problems

    @property
    def serves(self) -> bool:
        """Whether an e-stop that arrives now can share this result, if an e-stop was open here since its start."""
        limit_s = _ANSWER_S if self._problems is None else SHARED_S
        return time.monotonic() < self._begun + limit_s

    def result(self) -> list[str] | None:
        """The problems; None while they are not known."""
        problems, moving = self._problems, [one.name for one in self._resources() if one.moving]
        if time.monotonic() < self._begun + _ANSWER_S and (problems is None or moving):
            return None
        late = ["its stop services did not end"] if problems is None else []
        return [*(problems or ()), *late, *(f"{name} still moves" for name in moving)]


class Pending(Struct, gc=False):
    """A request that is not confirmed yet: an e-stop, or ids to clear."""

    request: str
    round: Round | None = None
    opened: Estop | None = None
    cleared: Sequence[str] = ()
    noted: bool = False
    """Whether it is on disk."""
    problem: str = ""
    relayed: "Sequence[PendingEstop]" = ()
    """Where it is passed on to, such as another system."""

    def result(self) -> str | None:
        """The problems, as one text; None while they are not known."""
        failed = [] if self.round is None else self.round.result()
        passed_on = [one.result() for one in self.relayed]
        if failed is None or None in passed_on:
            return None
        return "; ".join(filter(None, [*failed, *passed_on, self.problem]))


class PendingEstop:
    """An e-stop that is passed on, until the subscriber has answered."""

    def __init__(self, estop: Estop) -> None:
        self.estop: Final = estop
        self.problem: str | None = None
        """Empty: it is carried out there."""
        self._begun = time.monotonic()

    def result(self) -> str | None:
        """The problem; None while it is not known."""
        if self.problem is None and time.monotonic() >= self._begun + _ANSWER_S:
            return f"it is passed on, and not confirmed there within {_ANSWER_S} s"
        return self.problem


class Worker:
    """A thread that runs only while there is work.

    Args:
        step: does the work; returns after how many seconds to call it again, or None if all is done.
        name: the name of the thread.
    """

    def __init__(self, step: Callable[[], float | None], name: str) -> None:
        self._step = step
        self._name = name
        self._changed = threading.Condition()
        self._woken = False
        self._thread: threading.Thread | None = None

    def wake(self) -> None:
        """Starts or wakes the thread, because there is work."""
        with self._changed:
            self._woken = True
            self._changed.notify()
            if self._thread is None:
                thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                thread.start()
                self._thread = thread

    def _run(self) -> None:
        while True:
            with self._changed:
                self._woken = False
            wait_s = self._once()
            with self._changed:
                if self._woken:
                    continue
                if wait_s is None:
                    self._thread = None
                    return
                self._changed.wait(wait_s)

    def _once(self) -> float | None:
        try:
            return self._step()
        except Exception:
            _logger.exception("an e-stop could not be processed")
            return SHARED_S

    def close(self) -> None:
        """Waits for work under way. Idempotent."""
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(_ANSWER_S)


class Relay:
    """Calls a subscriber with each e-stop while it is open, one after the other."""

    def __init__(self, callback: Callable[[Estop], str], is_open: Callable[[str], bool]) -> None:
        self.callback: Final = callback
        self._is_open = is_open
        self._guard = threading.Lock()
        self._waiting: dict[str, PendingEstop] = {}
        self._worker = Worker(self._next, "trade-estop-relay")

    def give(self, estop: Estop) -> PendingEstop:
        """Adds an e-stop; does not wait."""
        added = PendingEstop(estop)
        with self._guard:
            self._waiting = {name: one for name, one in self._waiting.items() if self._is_open(name)}
            self._waiting[estop.id] = added
        self._worker.wake()
        return added

    def _next(self) -> float | None:
        with self._guard:
            if not self._waiting:
                return None
            one = self._waiting.pop(next(iter(self._waiting)))
        one.problem = self.callback(one.estop) if self._is_open(one.estop.id) else ""
        return 0.0

    def close(self) -> None:
        """Waits for the call under way. Idempotent."""
        with self._guard:
            self._waiting.clear()
        self._worker.close()
