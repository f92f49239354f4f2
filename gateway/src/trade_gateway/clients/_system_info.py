"""What clients are told of the system itself: who may read, instrument or administer it is judged by the policy."""

import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any, Final

from trade import Container, HookInfo, LoadInfo, LogLine, LogReader, NotificationInfo, Sight, Span
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._audit_reader import newest
from trade_gateway.clients._authorizer import ClientAuthorizer
from trade_gateway.clients._errors import NoAuditRecord
from trade_gateway.clients._load_table import loads
from trade_gateway.clients._span_reader import CallReader

_ROWS: Final = 200
"""Of the audit records."""
_SIGHT_S: Final = 2.0
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
        self._sight: Sight | None = None
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

    async def sight(self, who: str) -> Sight:
        """Whom the door has found, and where nobody; looked at once for all who ask within two seconds.

        Raises:
            AccessDenied: an identity may do nothing here but stop; likewise for containers and loads.
        """
        self._judge.require_some(who, "sight")
        return await self._counted(who, self._look)

    def _look(self) -> Sight:
        with self._looking:
            if self._sight is None or time.monotonic() - self._looked_at > _SIGHT_S:
                self._sight = self._container.sight(limit_s=0)
                self._looked_at = time.monotonic()
            return self._sight

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
