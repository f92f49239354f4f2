"""Ends silent sessions, and those of clients that are no longer admitted."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from trade_gateway.clients import Client, ClientApi

_LOOK_EVERY_S: Final = 1.0
"""How soon a revoked token ends a session, in seconds."""


class Lease:
    """The lease of one session."""

    def __init__(self, lease_s: float, still: Callable[[], bool]) -> None:
        self.lease_s = lease_s
        self.still = still
        self.timer: asyncio.TimerHandle | None = None


class Leases:
    """The leases of all sessions. Belongs to the event loop."""

    def __init__(self, api: ClientApi) -> None:
        self._api = api
        self._leases: dict[Client, Lease] = {}
        self._closing: set[asyncio.Task[None]] = set()

    def begin(self, client: Client, lease_s: float, still: Callable[[], bool]) -> None:
        """Adds a session.

        Args:
            client: its client.
            lease_s: how long it lasts without a request, in seconds; 0 for one that lasts as its connection does.
            still: whether the client is still admitted.
        """
        self._leases[client] = Lease(lease_s, still)
        loop = asyncio.get_running_loop()

        def forget() -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._forget, client)

        client.when_closed(forget)
        self.renew(client)

    def lease_s(self, client: Client) -> float:
        """How long the session may be silent, in seconds."""
        lease = self._leases.get(client)
        return 0.0 if lease is None else lease.lease_s

    def renew(self, client: Client) -> None:
        """Renews the lease."""
        lease = self._leases.get(client)
        if lease is None or not lease.lease_s:
            return
        if lease.timer is not None:
            lease.timer.cancel()
        lease.timer = asyncio.get_running_loop().call_later(lease.lease_s, self._end, client)

    async def keep_watch(self) -> None:
        """Ends the sessions of clients that are no longer admitted, until this task is cancelled."""
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            for client, lease in self._leases.copy().items():
                if not lease.still():
                    self._end(client)

    def _end(self, client: Client) -> None:
        closing = asyncio.ensure_future(self._api.in_thread(client.close, stops=True))
        self._closing.add(closing)
        closing.add_done_callback(self._closing.discard)

    def _forget(self, client: Client) -> None:
        lease = self._leases.pop(client, None)
        if lease is not None and lease.timer is not None:
            lease.timer.cancel()
