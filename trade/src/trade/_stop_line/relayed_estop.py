"""An e-stop through other containers: each gives it under the same id to all that it sees (S09)."""

import contextlib
import time
from typing import Any, Final

import msgspec

from trade._calls.handle import CallHost, Handle
from trade._calls.run import Run
from trade._estop.broadcast import EstopReport, all_of, as_seen_here
from trade._protocol.keys import DOMAIN
from trade._registry.constraints import where
from trade._registry.registry import Record, Registry
from trade.errors import TradeError

ESTOP: Final = "estop"
_RELAYS: Final = 4
"""How many containers are asked: each sends the e-stop to all that it sees, and repeats it."""


class RelayedEstop:
    """An e-stop under way at some of the containers that are known here."""

    def __init__(self, home: CallHost, registry: Registry, estop_id: str, reason: str, limit_s: float) -> None:
        self._id = estop_id
        self._until = time.monotonic() + limit_s
        others = [record for record in registry.select(where(name=ESTOP, group=DOMAIN)) if not record.local]
        begun = (_begun(home, record, reason, estop_id, limit_s) for record in others[:_RELAYS])
        self._runs = [run for run in begun if run is not None]

    def report(self) -> EstopReport:
        """The answers so far, merged."""
        ended = [run for run in self._runs if run.done() and run.exception(0) is None]
        return all_of(self._id, [as_seen_here(msgspec.convert(run.result(0), EstopReport)) for run in ended])

    def wait(self) -> EstopReport:
        """Waits until all have answered, or the time is over."""
        for run in self._runs:
            _wait(run, self._until - time.monotonic())
        return self.report()


def _begun(home: CallHost, record: Record, reason: str, estop_id: str, limit_s: float) -> "Run[Any] | None":
    try:
        return Handle(home, record.key, record).start(reason, estop_id, limit_s)
    except TradeError:  # it has left, or the container is of an earlier version, which takes no id
        return None


def _wait(run: "Run[Any]", left_s: float) -> None:
    if left_s > 0 and not run.done():
        with contextlib.suppress(TimeoutError, TradeError):  # it was not over in time
            run.exception(left_s)
