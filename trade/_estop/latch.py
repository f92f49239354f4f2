"""The e-stop latch of one container (S09): it latches at once, stops, writes to disk, confirms, and clears.

The other side, which gives the order and waits for confirmations, is `broadcast`.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from trade._audit.events import Audit
from trade._estop.deadman import Deadman
from trade._estop.ledger import Ledger, age, as_reported, identity_of
from trade._estop.store import EstopStore
from trade._estop.worker import SHARED_S, Pending, Relay, Round, Worker
from trade._resources.lock_table import LockTable
from trade._resources.resource import Latch
from trade.protocol.keys import Address
from trade.protocol.messages import Estop, EstopOrder

_logger = logging.getLogger("trade")

_LOOK_AGAIN_S: Final = 0.005
_WRITE_AGAIN_S: Final = 1.0
"""The pause before what could not be written is written again."""

Confirm = Callable[[str, str], None]
"""Confirms a request, with the problem if a part failed; does not wait."""


class EstopLatch:
    """The open e-stops of this container. While one is open, no actuating call begins here.

    Args:
        table: its resources.
        deadman: stops them.
        store: keeps open e-stops on disk.
        confirm: sends the confirmation.
        changed: called, on another thread, when the set of open e-stops has changed.
        keeps: whether this container has something to stop, so that it must remember them.
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
        self._ledger = Ledger(store.read())
        self._pending: dict[str, Pending] = {}
        self._round: Round | None = None
        """The last round of stops, if an e-stop was open here ever since it began."""
        self._finished = 0.0
        self._unwritten = set[str]()
        """The e-stops that could not be written to disk."""
        self._write_again_at = 0.0
        self._closed = False
        self._worker = Worker(self._work, "trade-estop-work")
        self._relays: list[Relay] = []
        self._latch()

    def open(self) -> tuple[Estop, ...]:
        """The open e-stops, oldest first."""
        with self._guard:
            return tuple(sorted(self._ledger.open.values(), key=age))

    def is_open(self, estop_id: str) -> bool:
        """Whether that one is open here."""
        return estop_id in self._ledger.open

    def is_cleared(self, estop_id: str) -> bool:
        """Whether it was cleared here recently."""
        return estop_id in self._ledger.cleared

    def knows(self, estop_id: str) -> bool:
        """Whether an e-stop of that id was opened or cleared here."""
        with self._guard:
            return self._ledger.knows(estop_id)

    def subscribe(self, callback: Callable[[Estop], str]) -> None:
        """Calls this, on another thread, with every open and every future e-stop; it returns the problem, or empty.

        A future one is confirmed here once each callback has returned.
        """
        relay = Relay(callback, self.is_open)
        self._relays = [*self._relays, relay]
        for estop in self.open():
            relay.give(estop)

    def unsubscribe(self, callback: Callable[[Estop], str]) -> None:
        """Calls it no more."""
        for relay in [one for one in self._relays if one.callback == callback]:
            self._relays = [one for one in self._relays if one is not relay]
            relay.close()

    def take(self, order: EstopOrder, identity: str) -> None:
        """Carries out an identity's order, without waiting; a repeated order is confirmed again."""
        with self._guard:
            known = self._ledger.knows(order.request)
            if known and order.opened is not None:
                self._ledger.update_report(order.opened)
            answer = self._ledger.answer(order.request) if known else None
            if not known:
                self._start(order.request, order.opened)
        if answer is not None:
            self._confirm(order.request, answer)
        elif not known and order.opened is not None:
            self._begin(order.opened)
        elif not known:
            self._clear(order.request, order.cleared, identity)

    def learn(self, estops: Iterable[Estop], reporter: Address) -> None:
        """Opens the open e-stops of another container, except those that were cleared here."""
        for estop in as_reported(estops, reporter):
            with self._guard:
                if not self._ledger.wants(estop):
                    continue
                self._start(estop.id, estop)
            self._begin(estop)

    def _start(self, request: str, opened: Estop | None) -> None:
        self._pending.pop(self._ledger.begin(request, opened), None)

    def keep(self) -> None:
        """Writes the open e-stops to disk, because this container has something to stop from now on."""
        for estop in self.open():
            if problem := self._written(estop):
                _logger.error("e-stop %s %s", estop.id, problem)
                self._worker.wake()

    # --- stopping

    def _begin(self, estop: Estop) -> None:
        reason = f"e-stop {estop.id}{f': {estop.reason}' if estop.reason else ''}"
        why = f"{estop.reason} (reported by {estop.told_by})".lstrip() if estop.told_by else estop.reason
        self._audit.note("stop", "e-stop", about=estop.id, who=identity_of(estop), session=estop.by, why=why)
        with self._guard:
            self._latch()
            fresh = self._round is None or not self._round.serves
            stopping = Round(self._table.resources) if self._round is None or fresh else self._round
            self._round = stopping
        try:
            for resource in self._table.resources():
                resource.stop(estop.by, (estop.by,), reason, estop=True)
            if fresh:
                stopping.begin(self._deadman)
        finally:
            relayed = [relay.give(estop) for relay in self._relays]
            self._wait(Pending(estop.id, stopping, opened=estop, relayed=relayed))
        if fresh and self._keeps():
            _logger.error("%s, by %s: everything here stops", reason, estop.giver)

    def _written(self, estop: Estop) -> str:
        """Writes an e-stop to disk unless it was cleared meanwhile; returns the problem."""
        try:
            self._store.write(estop)
            if not self.is_open(estop.id):
                self._store.remove(estop.id)
        except OSError as bad:
            self._unwritten.add(estop.id)
            return f"is not written down and will not outlive this process: {bad}"
        self._unwritten.discard(estop.id)
        return ""

    def _write_again(self) -> float | None:
        """Writes what could not be written, once a second; returns when to call this again, in seconds."""
        if self._closed or not self._unwritten:
            return None
        if (early_s := self._write_again_at - time.monotonic()) > 0:
            return early_s
        unwritten = [*self._unwritten]
        opened = {estop.id: estop for estop in self.open()}
        for estop_id in unwritten:
            if estop_id not in opened:  # it was cleared
                self._unwritten.discard(estop_id)
            elif self._written(opened[estop_id]):
                self._write_again_at = time.monotonic() + _WRITE_AGAIN_S
                return _WRITE_AGAIN_S
            else:
                _logger.warning("e-stop %s is written down now", estop_id)
        return None

    # --- clearing

    def _clear(self, request: str, ids: Sequence[str], identity: str) -> None:
        self._audit.note("stop", "e-stop cleared", about=list(ids), who=identity)
        with self._guard:
            self._ledger.clear(ids)
            if not self._ledger.open:
                self._round = None
            self._latch()
        self._wait(Pending(request, cleared=ids))

    def _removed(self, ids: Sequence[str]) -> str:
        try:
            for estop_id in ids:
                self._store.remove(estop_id)
        except OSError as bad:
            return f"is cleared, but its file stays on disk and will be read at the next start: {bad}"
        return ""

    # --- both

    def _latch(self) -> None:
        first = self._ledger.first
        self._table.estop(None if first is None else Latch(first.by, f"e-stop {first.id}: {first.reason}"))

    def _wait(self, pending: Pending) -> None:
        with self._guard:
            self._pending[pending.request] = pending
        self._worker.wake()

    def _work(self) -> float | None:
        """Writes new e-stops to disk, and confirms finished ones; returns when to check again, in seconds."""
        with self._guard:
            pending, replaced = list(self._pending.values()), list(self._ledger.replaced)
        if replaced and (early_s := self._finished + SHARED_S - time.monotonic()) > 0:
            return early_s  # too many e-stops: each report of one costs every container
        for one in pending:
            self._persist(one)
        if problem := self._removed([name for name in replaced if not self.is_open(name)]):
            _logger.error("an e-stop that a newer one has replaced %s", problem)
        del self._ledger.replaced[: len(replaced)]
        finished = [(one, result) for one in pending if (result := one.result()) is not None]
        if finished:
            self._finish(finished)
        again_s = self._write_again()
        return _LOOK_AGAIN_S if self._pending else again_s

    def _persist(self, pending_request: Pending) -> None:
        if pending_request.noted:
            return
        pending_request.noted = True
        if pending_request.opened is None:
            pending_request.problem = self._removed(pending_request.cleared)
        elif self._keeps() and self.is_open(pending_request.opened.id):
            pending_request.problem = self._written(pending_request.opened)

    def _finish(self, finished: Sequence[tuple[Pending, str]]) -> None:
        with self._guard:
            for one, problem in finished:
                self._ledger.answered(one.request, problem)
                self._pending.pop(one.request, None)
        self._finished = time.monotonic()
        self._changed()  # first: a client with all confirmations may look at the entries at once
        for one, problem in finished:
            if problem:
                _logger.error("e-stop %s: %s", one.request, problem)
            self._confirm(one.request, problem)

    def close(self) -> None:
        """Waits for work under way. Idempotent."""
        self._closed = True
        if self._unwritten:
            self._worker.wake()
        self._worker.close()
        for relay in self._relays:
            relay.close()
