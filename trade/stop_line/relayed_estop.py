"""An e-stop through other containers: each gives it under the same id to all that it sees (S09)."""

import contextlib
import threading
import time
from collections.abc import Sequence
from typing import Final

import msgspec

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._estop.broadcast import EstopReport, all_of, as_seen_here
from trade._registry.constraints import where
from trade.protocol.keys import DOMAIN

ESTOP: Final = "estop"
_RELAYS: Final = 4
"""How many containers are asked: each sends the e-stop to all that it sees, and repeats it."""


class RelayedEstop:
    """An e-stop under way at some of the containers that are known here.

    Each is asked in a thread of its own: a link that takes nothing holds up neither the others nor the e-stop itself.
    """

    def __init__(self, client: CallClient, estop_id: str, reason: str, limit_s: float) -> None:
        self._id = estop_id
        self._until = time.monotonic() + limit_s
        self._reports: list[EstopReport] = []
        self._changed = threading.Condition()
        others = [record for record in client.registry.select(where(name=ESTOP, group=DOMAIN)) if not record.local]
        self._unfinished = len(others[:_RELAYS])
        for record in others[:_RELAYS]:
            words = (client.handle_of(record), (reason, estop_id, limit_s))
            threading.Thread(target=self._ask, args=words, name="trade-estop-ask", daemon=True).start()

    def _ask(self, handle: Handle, words: Sequence[object]) -> None:
        found: list[EstopReport] = []
        with contextlib.suppress(Exception):  # it has left, or takes no id; whatever it is, the others count
            found = [as_seen_here(msgspec.convert(handle(*words), EstopReport))]
        with self._changed:
            self._reports += found
            self._unfinished -= 1
            self._changed.notify_all()

    def report(self) -> EstopReport:
        """The answers so far, merged."""
        with self._changed:
            return all_of(self._id, self._reports)

    def wait(self) -> EstopReport:
        """Waits until all have answered, or the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._unfinished == 0, max(0.0, self._until - time.monotonic()))
        return self.report()
