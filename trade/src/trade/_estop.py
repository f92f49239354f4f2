"""E-stops as they hold in one container (S09): latched at once, stopped, written down, confirmed, in the end cleared.

The other side, who orders one and waits for the confirmations, is `_estop_line`.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Final

from trade._audit import Audit
from trade._deadman import Deadman
from trade._estop_store import EstopStore
from trade._locks import LockTable
from trade._resources import Latch
from trade._session import foreign
from trade._wire import Estop, EstopOrder

_logger = logging.getLogger("trade")

_ANSWER_S: Final = 2.5
"""When a container says what did not come to rest; a stop service that does not return is reported after 2 s."""
_LOOK_AGAIN_S: Final = 0.005
_MOST_REQUESTS: Final = 4096

Confirm = Callable[[str, str], None]
"""Says that a request was done, and what of it failed; waits for nobody."""


class Estops:
    """What is open here. Nothing that actuates begins in this container while anything is.

    Args:
        table: its resources.
        deadman: what stops them.
        store: where open ones outlive the process.
        confirm: tells who asked.
        changed: called, on a thread of its own, when what is open has become another set.
        keeps: whether this container has something to stop, so that it must remember.
    """

    def __init__(
        self,
        table: LockTable,
        deadman: Deadman,
        store: EstopStore,
        confirm: Confirm,
        changed: Callable[[], None],
        keeps: Callable[[], bool],
        audit: Audit,
    ) -> None:
        self._audit = audit
        self._table = table
        self._deadman = deadman
        self._store = store
        self._confirm = confirm
        self._changed = changed
        self._keeps = keeps
        self._guard = threading.Lock()
        self._open = {estop.id: estop for estop in store.read()}
        self._answers: dict[str, str | None] = dict.fromkeys(self._open, "")
        """What was asked already, with what failed of it; None: not done yet. What is here is not begun again."""
        self._threads: list[threading.Thread] = []
        self.heard: list[Callable[[Estop], None]] = []
        """Called, each on a thread of its own, with every e-stop that is opened."""
        self._latch()

    def open(self) -> tuple[Estop, ...]:
        """Those that are open, oldest first."""
        with self._guard:
            return tuple(sorted(self._open.values(), key=_age))

    def take(self, order: EstopOrder, who: str) -> None:
        """Do what that identity asks, without waiting; an order that comes again is confirmed again."""
        answer = self._first(order.request, order.opened)
        if answer is not None:
            if answer[0] is not None:
                self._confirm(order.request, answer[0])
        elif order.opened is not None:
            self._begin(order.opened)
        else:
            self._clear(order.request, order.cleared, who)

    def learn(self, estops: Iterable[Estop]) -> None:
        """Others have these open: take the union. One that was cleared here is not opened again."""
        for estop in estops:
            if self._first(estop.id, estop) is None:
                self._begin(estop)

    def keep(self) -> None:
        """This container has something to stop from now on: what is open is written down."""
        for estop in self.open():
            if problem := self._written(estop):
                _logger.error("e-stop %s %s", estop.id, problem)

    def _first(self, request: str, opened: Estop | None) -> tuple[str | None] | None:
        """None if it is asked for the first time, and what it opens is open then; else how far it is."""
        with self._guard:
            if request in self._answers:
                return (self._answers[request],)
            self._answers[request] = None
            if opened is not None:
                self._open[opened.id] = opened
            while len(self._answers) > _MOST_REQUESTS:
                self._answers.pop(next(iter(self._answers)))
            return None

    # --- stopping

    def _begin(self, estop: Estop) -> None:
        begun = time.monotonic()
        reason = f"e-stop {estop.id}{f': {estop.reason}' if estop.reason else ''}"
        who = foreign(estop.by) or estop.by.partition("/")[0]
        self._audit.note("stop", "e-stop", about=estop.id, who=who, session=estop.by, why=estop.reason)
        with self._guard:
            self._latch()
        for resource in self._table.resources():
            resource.stop(estop.by, (estop.by,), reason, estop=True)
        ended = threading.Event()
        problems: list[str] = []

        def stopped(failed: Sequence[str]) -> None:
            problems.extend(failed)
            ended.set()

        self._deadman.everything(stopped)
        if self._keeps():
            _logger.error("%s, by %s: everything here stops", reason, estop.by)

        def finish() -> None:
            unwritten = self._written(estop) if self._keeps() else ""
            ended.wait(max(0.0, begun + _ANSWER_S - time.monotonic()))
            failed = [*problems, *self._still_moving(begun + _ANSWER_S), *([unwritten] if unwritten else [])]
            self._done(estop.id, "; ".join(failed))

        self._apart(finish)
        for tell in self.heard:
            self._apart(partial(tell, estop))

    def knows(self, estop_id: str) -> bool:
        """Whether an e-stop of that id was opened or cleared here."""
        with self._guard:
            return estop_id in self._answers

    def _written(self, estop: Estop) -> str:
        """Write it down unless it is cleared meanwhile; what went wrong."""
        try:
            self._store.write(estop)
            with self._guard:
                cleared = estop.id not in self._open
            if cleared:
                self._store.remove(estop.id)
        except OSError as bad:
            return f"is not written down and will not outlive this process: {bad}"
        return ""

    def _still_moving(self, until: float) -> list[str]:
        while moving := [resource.name for resource in self._table.resources() if resource.moving]:
            if time.monotonic() >= until:
                return [f"{name} still moves" for name in moving]
            threading.Event().wait(_LOOK_AGAIN_S)
        return []

    # --- clearing

    def _clear(self, request: str, ids: Sequence[str], who: str) -> None:
        self._audit.note("stop", "e-stop cleared", about=list(ids), who=who)
        with self._guard:
            for estop_id in ids:
                self._open.pop(estop_id, None)
                self._answers.setdefault(estop_id, "")  # what still travels of it opens nothing again
            self._latch()

        def finish() -> None:
            try:
                for estop_id in ids:
                    self._store.remove(estop_id)
                problem = ""
            except OSError as bad:
                problem = f"is cleared, but its note on disk stays and will be read at the next start: {bad}"
            self._done(request, problem)

        self._apart(finish)

    # --- both

    def _latch(self) -> None:
        first = min(self._open.values(), key=_age, default=None)
        self._table.estop(None if first is None else Latch(first.by, f"e-stop {first.id}: {first.reason}"))

    def _done(self, request: str, problem: str) -> None:
        with self._guard:
            self._answers[request] = problem
        if problem:
            _logger.error("e-stop %s: %s", request, problem)
        self._changed()  # first: who has heard of everybody may look at once
        self._confirm(request, problem)

    def _apart(self, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, name="trade-estop-work", daemon=True)
        self._threads = [*(known for known in self._threads if known.is_alive()), thread]
        thread.start()

    def close(self) -> None:
        """Wait for what is being done. Idempotent."""
        for thread in self._threads:
            thread.join(_ANSWER_S)


def _age(estop: Estop) -> tuple[float, str]:
    return estop.at, estop.id
