"""What clients are told of the system itself, its calls and its audit record, as far as the policy lets them."""

import heapq
import sqlite3
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from trade import Container, Handle, HookInfo, LoadInfo, LogLine, LogReader, NotificationInfo, Reachability, Span, where
from trade.auditing import AuditRow, reading, records_in
from trade.errors import AccessDenied, ConfigurationError
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._authorizer import ClientAuthorizer
from trade_gateway.clients._errors import NoAuditRecord
from trade_gateway.clients._load_table import loads
from trade_gateway.clients._schemas import AuditView


def newest(folder: Path, most: int) -> list[AuditView]:
    """The newest rows of all records, the newest first.

    Raises:
        ConfigurationError: one of them cannot be read.
    """
    found = [_view(path.stem, row) for path in records_in(folder) for row in _last(path, most)]
    return heapq.nlargest(most, found, key=lambda view: view.at)


def _last(path: Path, most: int) -> Iterator[AuditRow]:
    try:
        with reading(path) as (end, _):
            after = max(0, end.seq - most)
        with reading(path, after) as (_, links):
            yield from (link.row for link in links)
    except (sqlite3.Error, msgspec.ValidationError) as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad}") from None


def _view(container: str, row: AuditRow) -> AuditView:
    return AuditView(
        at=row.at_ns / 1e9,
        container=container,
        kind=row.kind,
        what=row.what,
        about=row.about,
        who=row.who,
        session=row.session,
        outcome=row.outcome,
        why=row.why,
        call_id=str(row.call_id),
    )


_MOST: Final = 200
"""Of what was noted before anybody asked."""


class CallReader:
    """Reads on where it was: each call once, or twice if who called and who served it are both traced.

    Args:
        container: of whose system.
        reads: also calls of services that only read.
    """

    def __init__(self, container: Container, *, reads: bool) -> None:
        self._container = container
        self._reads = reads
        self._read: dict[Handle, int] = {}
        """By what tells of a container's calls, the number of the last one told."""

    def read(self) -> list[Span]:
        """What has ended since the last time, in the order in which it began; the first time the newest 200.

        Raises:
            AccessDenied: the policy does not let this container read group ``trade``.
        """
        handles, first = self._container.services(where(name="spans", group="trade")), not self._read
        reading = [] if self._reads else [one for one in self._container.services() if one.effect == "read"]
        left_out = {one.label for one in reading}
        new: list[Span] = []
        for outcome in self._container.call_all([one.bind(None, self._read.get(one, 0)) for one in handles]):
            if isinstance(outcome.error, AccessDenied):
                raise outcome.error
            if not outcome.ok:  # it has left meanwhile
                continue
            spans: list[Span] = outcome.result
            self._read[outcome.handle] = spans[-1].number if spans else self._read.get(outcome.handle, 0)
            new += [span for span in spans if span.service not in left_out]
        new.sort(key=lambda span: (span.began, span.call_id))
        return new[-_MOST:] if first else new


_ROWS: Final = 200
"""Of the audit records."""
_REACHABILITY_S: Final = 2.0
"""How old it may be: finding out why there is no link takes as long."""

Counted = Callable[..., Coroutine[Any, Any, Any]]
"""Does something in a thread, as one of what an identity may have under way."""


class Overview:
    """Of the system that clients are let into.

    Args:
        container: that acts for them.
        judge: of its clients.
        counted: called with an identity, what to do, and with which arguments.
    """

    def __init__(self, container: Container, judge: ClientAuthorizer, counted: Counted) -> None:
        self._container = container
        self._judge = judge
        self._counted = counted
        self._looking = threading.Lock()
        self._reachability: Reachability | None = None
        self._looked_at = 0.0

    def me(self, who: str) -> messages.Me:
        """What an identity is here."""
        administers, reads, instruments = (
            self._judge.may_system(who, verb) for verb in ("administer", "read", "instrument")
        )
        return messages.Me(who, administers, reads, instruments)

    def policy(self, who: str) -> messages.PolicyView:
        """Who may do what. Raises AccessDenied."""
        self._judge.require_system(who, "read", "policy")
        return messages.policy_view(self._judge.policy)

    async def audit(self, who: str) -> list[messages.AuditView]:
        """The newest rows of the audit records of this host. Raises AccessDenied, NoAuditRecord."""
        self._judge.require_system(who, "administer", "audit")
        folder = self._container.settings.audit
        if folder is None:
            raise NoAuditRecord
        return await self._counted(who, newest, folder, _ROWS)

    async def set_tracing(self, who: str, *, on: bool) -> list[str]:
        """Have the system's containers note calls; which of them do. Raises AccessDenied."""
        self._judge.require_system(who, "instrument", "tracing")
        return await self._counted(who, self._container.set_tracing, on)

    async def calls(self, who: str, reader: CallReader) -> list[Span]:
        """What calls have ended since the last time. Raises AccessDenied."""
        self._judge.require_system(who, "read", "calls")
        return await self._counted(who, reader.read)

    def ended(self, *, reads: bool) -> CallReader:
        """Of the calls of the system that are noted, from what is kept of them."""
        return CallReader(self._container, reads=reads)

    async def reachability(self, who: str) -> Reachability:
        """Whom the door has found, and where nobody; looked at once for all who ask within two seconds.

        Raises:
            AccessDenied: an identity may do nothing here but stop; likewise for containers and loads.
        """
        self._judge.require_some(who, "sight")
        return await self._counted(who, self._look)

    def _look(self) -> Reachability:
        with self._looking:
            if self._reachability is None or time.monotonic() - self._looked_at > _REACHABILITY_S:
                self._reachability = self._container.reachability(limit_s=0)
                self._looked_at = time.monotonic()
            return self._reachability

    def containers(self, who: str) -> list[messages.ContainerView]:
        """Those of the system."""
        self._judge.require_some(who, "containers")
        return [messages.ContainerView(one.name, one.identity, one.host) for one in self._container.containers()]

    async def loads(self, who: str) -> list[LoadInfo]:
        """How busy they are; takes a second."""
        self._judge.require_some(who, "loads")
        return await self._counted(who, loads, self._container)

    async def notifications(self, who: str) -> list[NotificationInfo]:
        """Those that stand. Raises AccessDenied."""
        self._judge.require_system(who, "read", "notifications")
        return await self._counted(who, self._container.notifications)

    async def hooks(self, who: str) -> list[HookInfo]:
        """Those that are attached. Raises AccessDenied."""
        self._judge.require_system(who, "read", "hooks")
        return await self._counted(who, self._container.hooks)

    async def log_lines(self, who: str, reader: LogReader) -> list[LogLine]:
        """What the system has logged since the last time. Raises AccessDenied."""
        self._judge.require_system(who, "read", "log")
        return await self._counted(who, reader.read)

    def log(self) -> LogReader:
        """Of all processes of the system, from what they still have on."""
        return LogReader(self._container, "*")
