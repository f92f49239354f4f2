"""Human approval of calls: a call that the policy or the command line marks waits, and runs once when approved."""

import asyncio
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import msgspec
from anyio.to_thread import run_sync
from msgspec import Struct

from trade import Container, Handle, current_call, service
from trade.errors import AccessDenied, ConfigurationError
from trade.protocol.keys import client_name, client_of
from trade.protocol.schema_types import publish
from trade_gateway.clients import ClientAuthorizer
from trade_gateway.clients._errors import NeedsApproval
from trade_gateway.clients._schemas import APPROVALS

_MOST: Final = 16
_MOST_TEXT: Final = 2_000
"""Greatest length of the arguments; a call that cannot be shown in full is refused."""


class Request(Struct, frozen=True):
    """A call that waits for approval."""

    id: str
    agent: str
    service: str
    args: str
    """As JSON."""
    why: str
    """In the agent's words."""
    asked_at: float
    """``time.time()``"""
    until: float
    """The time of its automatic refusal."""


publish("trade_gateway.mcp", Request)


class _PendingApproval(Struct):
    request: Request
    group: str
    tell: Callable[[str], None]
    """Called once: with the reason for a refusal, or empty for an approval."""


class Approvals:
    """Requests of the agents for which a container acts, as services of group ``approvals``.

    Clients that may call these services and administer the target may approve, except for the agent itself.

    Args:
        container: the agent's container, or that of an HTTP gateway with agents.
        ask_first: groups in which every call with an effect needs approval, whatever the policy says.
    """

    def __init__(self, container: Container, ask_first: Sequence[str] = ()) -> None:
        self._container = container
        self._judge = ClientAuthorizer(container)
        self._ask_first = tuple(ask_first)
        self._guard = threading.Lock()
        self._waiting: dict[str, _PendingApproval] = {}
        self._offered = False
        self._offering = asyncio.Lock()

    # --- services

    @service(effect="read")
    def pending(self) -> list[Request]:
        """The calls that wait for approval, oldest first."""
        with self._guard:
            return [one.request for one in self._waiting.values()]

    @service(effect="note")
    def approve(self, id: str) -> Request:  # noqa: A002 - as `pending` names it
        """Approve one call, exactly as requested.

        Raises:
            ConfigurationError: no call with that id waits.
            AccessDenied: the caller does not administer the target, or is the agent itself.
        """
        return self._settle(id, "")

    @service(effect="note")
    def refuse(self, id: str, reason: str = "") -> Request:  # noqa: A002
        """Refuse one call. Raises like ``approve``."""
        by = current_call()
        return self._settle(id, f"{by.caller if by else 'a client'} refused{f': {reason}' if reason else ''}")

    def _settle(self, name: str, verdict: str) -> Request:
        with self._guard:
            waiting = self._waiting.get(name)
        if waiting is None:
            raise ConfigurationError(
                where=f"approval {name!r}", problem="no call with that id waits. See `trade approvals`"
            )
        self._require(waiting)
        with self._guard:
            if self._waiting.pop(name, None) is None:
                raise ConfigurationError(where=f"approval {name!r}", problem="another client has just decided it")
        waiting.tell(verdict)
        return waiting.request

    def _require(self, waiting: _PendingApproval) -> None:
        call, agent = current_call(), waiting.request.agent
        client = "" if call is None else client_of(call.session)
        if call is None or (not client and call.session.startswith(f"{self._container.address}")):
            rule = "the agent's own process cannot approve what it asks for"
            raise AccessDenied(who=agent, verb="administer", what=waiting.request.service, rule=rule)
        if call.caller == agent or client == client_name(agent):
            rule = (
                "an identity cannot approve its own call, with or without a policy; approve it under another identity"
            )
            raise AccessDenied(who=agent, verb="administer", what=waiting.request.service, rule=rule)
        for who in filter(None, (call.caller, client)):  # a program that acts for a client has both their limits
            self._container.access.require(who, "administer", waiting.group, waiting.request.service)

    # --- requests

    def needed(self, agent: str, handle: Handle) -> bool:
        """Whether a call of an agent needs approval."""
        return self._judge.needs_approval(agent, handle, self._ask_first)

    async def ask(self, agent: str, handle: Handle, args: Any, reason: str, wait_s: float) -> None:
        """Waits for approval. Raises NeedsApproval: there was none within ``wait_s``."""
        text = msgspec.json.encode(args).decode()
        if len(text) > _MOST_TEXT:
            raise NeedsApproval(service=handle.label, reason="its arguments are too long to be shown")
        async with self._offering:
            await run_sync(self._offer, handle)
        now, name, loop = time.time(), secrets.token_hex(3), asyncio.get_running_loop()
        answered: asyncio.Future[str] = loop.create_future()

        def settle(verdict: str) -> None:
            if not answered.done():
                answered.set_result(verdict)

        request = Request(name, agent, handle.label, text, reason[:_MOST_TEXT], now, now + wait_s)
        waiting = _PendingApproval(request, handle.key.domain, lambda verdict: _soon(loop, partial(settle, verdict)))
        with self._guard:
            if len(self._waiting) >= _MOST:
                raise NeedsApproval(service=handle.label, reason=f"{_MOST} requests wait already")
            self._waiting[name] = waiting
        try:
            verdict = await asyncio.wait_for(answered, wait_s)
        except asyncio.TimeoutError:
            verdict = f"it was not approved within {wait_s:g} s (`trade approvals` shows what waits)"
        finally:
            with self._guard:
                self._waiting.pop(name, None)
        if verdict:
            raise NeedsApproval(service=handle.label, reason=verdict)

    def _offer(self, handle: Handle) -> None:
        """Offers the services at the first request, so that an agent without requests needs no right to offer them."""
        if self._offered:
            return
        try:
            self._container.register(self, f"{APPROVALS}.{self._container.name}")
        except AccessDenied as denied:
            raise NeedsApproval(service=handle.label, reason=f"approval cannot be requested: {denied}") from None
        self._offered = True


def _soon(loop: asyncio.AbstractEventLoop, do: Callable[[], None]) -> None:
    if not loop.is_closed():
        loop.call_soon_threadsafe(do)
