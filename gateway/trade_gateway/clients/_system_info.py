"""Information for clients about the system itself, its calls and its audit record, within their rights."""

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
    """Returns the newest rows of all records, the newest first.

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
"""Number of calls that were recorded before the first request."""


class CallReader:
    """Reads recorded calls incrementally: each once, or twice if caller and callee are both traced.

    Args:
        container: its system is read.
        reads: whether calls of services that only read are included.
    """

    def __init__(self, container: Container, *, reads: bool) -> None:
        self._container = container
        self._reads = reads
        self._read: dict[Handle, int] = {}
        """For each source of a container's calls, the number of the last one read."""

    def read(self) -> list[Span]:
        """Returns the calls that have ended since the last read, in order of their start; at first the newest 200.

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
            if not outcome.ok:  # it has shut down meanwhile
                continue
            spans: list[Span] = outcome.result
            self._read[outcome.handle] = spans[-1].number if spans else self._read.get(outcome.handle, 0)
            new += [span for span in spans if span.service not in left_out]
        new.sort(key=lambda span: (span.began, span.call_id))
        return new[-_MOST:] if first else new


_ROWS: Final = 200
"""Number of rows of the audit records."""
_REACHABILITY_S: Final = 2.0
"""Longest age of a result, in seconds; finding out why a link is missing takes as long."""

Counted = Callable[..., Coroutine[Any, Any, Any]]
"""Runs a function in a thread, counted against the limits of an identity."""


class Overview:
    """Information about the system for its clients.

    Args:
        container: the gateway's container.
        judge: authorises its clients.
        counted: runs a function with its arguments for an identity.
    """

    def __init__(self, container: Container, judge: ClientAuthorizer, counted: Counted) -> None:
        self._container = container
        self._judge = judge
        self._counted = counted
        self._looking = threading.Lock()
        self._reachability: Reachability | None = None
        self._looked_at = 0.0

    def me(self, identity: str) -> messages.Me:
        """Returns the identity and its rights over the system."""
        administers, reads, instruments = (
            self._judge.may_system(identity, verb) for verb in ("administer", "read", "instrument")
        )
        return messages.Me(identity, administers, reads, instruments, self._judge.groups_of(identity, "administer"))

    def policy(self, identity: str) -> messages.PolicyView:
        """Returns the access policy. Raises AccessDenied."""
        self._judge.require_system(identity, "read", "policy")
        return messages.policy_view(self._judge.policy)

    async def audit(self, identity: str) -> list[messages.AuditView]:
        """Returns the newest rows of the audit records of this host. Raises AccessDenied, NoAuditRecord."""
        self._judge.require_system(identity, "administer", "audit")
        folder = self._container.settings.audit
        if folder is None:
            raise NoAuditRecord
        return await self._counted(identity, newest, folder, _ROWS)

    async def set_tracing(self, identity: str, *, on: bool) -> list[str]:
        """Turns tracing on or off in the system's containers; returns those that trace. Raises AccessDenied."""
        self._judge.require_system(identity, "instrument", "tracing")
        return await self._counted(identity, self._container.set_tracing, on)

    async def calls(self, identity: str, reader: CallReader) -> list[Span]:
        """Returns the calls that have ended since the last read. Raises AccessDenied."""
        self._judge.require_system(identity, "read", "calls")
        return await self._counted(identity, reader.read)

    def ended(self, *, reads: bool) -> CallReader:
        """Returns a reader of the system's recorded calls."""
        return CallReader(self._container, reads=reads)

    async def reachability(self, identity: str) -> Reachability:
        """Returns the containers found and the endpoints without any; shared by requests within two seconds.

        Raises:
            AccessDenied: an identity may do nothing here but stop; likewise for containers and loads.
        """
        self._judge.require_some(identity, "sight")
        return await self._counted(identity, self._look)

    def _look(self) -> Reachability:
        with self._looking:
            if self._reachability is None or time.monotonic() - self._looked_at > _REACHABILITY_S:
                self._reachability = self._container.reachability(limit_s=0)
                self._looked_at = time.monotonic()
            return self._reachability

    def containers(self, identity: str) -> list[messages.ContainerView]:
        """Returns the containers of the system."""
        self._judge.require_some(identity, "containers")
        return [messages.ContainerView(one.name, one.identity, one.host) for one in self._container.containers()]

    async def loads(self, identity: str) -> list[LoadInfo]:
        """Returns the containers' load; takes a second."""
        self._judge.require_some(identity, "loads")
        return await self._counted(identity, loads, self._container)

    async def notifications(self, identity: str) -> list[NotificationInfo]:
        """Returns the active notifications. Raises AccessDenied."""
        self._judge.require_system(identity, "read", "notifications")
        return await self._counted(identity, self._container.notifications)

    async def hooks(self, identity: str) -> list[HookInfo]:
        """Returns the attached hooks. Raises AccessDenied."""
        self._judge.require_system(identity, "read", "hooks")
        return await self._counted(identity, self._container.hooks)

    async def log_lines(self, identity: str, reader: LogReader) -> list[LogLine]:
        """Returns the system's log lines since the last read. Raises AccessDenied."""
        self._judge.require_system(identity, "read", "log")
        return await self._counted(identity, reader.read)

    def log(self) -> LogReader:
        """Returns a reader of all logs of the system, from the lines that are still kept."""
        return LogReader(self._container, "*")
