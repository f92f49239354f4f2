"""Links a running container to others, and makes it discoverable; the main session stays as it is.

One task, due only while it has work: it looks for containers while discovery is on, and dials a configured endpoint
again whenever its link is gone.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from trade._threads.scheduler import NEVER, Scheduler
from trade.errors import CannotConnect, ConfigurationError, LinkStays
from trade.transport.addresses import Attempt, Attempts
from trade.transport.endpoints import Endpoint, accepts
from trade.transport.interfaces import is_near
from trade.transport.scouting import Beacon
from trade.transport.zenoh_links import WITHOUT_HUB, Links

_logger = logging.getLogger("trade")

_ROUND_NS: Final = 1_000_000_000
_SCOUT_S: Final = 0.5
_JOIN_S: Final = 2.0
_END_S: Final = 5.0
_AGAIN_S: Final = 5.0
"""A peer that refused a link is not dialled again for this long."""
_REFUSED_S: Final = 3.0
"""A configured endpoint that accepts connections but is not linked within this time refuses this container."""


class Dialer:
    """The discovery switches of one container; thread-safe."""

    def __init__(
        self,
        links: Links,
        may_dial: Callable[[str], None],
        timers: Scheduler,
        configured: Sequence[str] = (),
        attempts: Attempts | None = None,
    ) -> None:
        self._links = links
        self._may_dial = may_dial
        self._lock = threading.RLock()
        self._beacon: Beacon | None = None
        self._discovering = False
        self.configured: Final = (links.hub,) if links.hub else tuple(configured)
        """The endpoints to dial that its settings name, or that of the hub of this host."""
        self.source: Final = "the hub of this host" if links.hub else "TRADE_CONNECT"
        """Where these are from."""
        self._kept: dict[str, str] = {endpoint: "" for endpoint in self.configured if Endpoint.read(endpoint).named}
        """From each endpoint to the id of the session found there; a name may have other addresses at each try."""
        self._unsure = list(self.configured)
        self._unsure_until = time.monotonic() + _REFUSED_S
        self._refused: dict[str, float] = {}
        self._attempts = attempts or Attempts(is_near)
        self._clock = timers.clock
        self._rounds = timers.due(self._round)
        self._closed = False
        self._rounds.by(0)

    @property
    def broadcasts(self) -> bool:
        return self._beacon is not None

    @property
    def discovers(self) -> bool:
        return self._discovering

    def set_broadcast(self, on: bool) -> None:
        with self._lock:
            self._check_dials(on)
            if on and self._beacon is None:
                self._beacon = self._links.beacon()
            elif not on:
                self._end_beacon()

    def _end_beacon(self) -> None:
        beacon, self._beacon = self._beacon, None
        if beacon is not None:
            beacon.close()

    def set_discovery(self, on: bool) -> None:
        with self._lock:
            self._check_dials(on)
            self._discovering = on
            self._refused.clear()
        self._rounds.by(0)

    def connect(self, endpoint: str) -> None:
        self._check_open()
        self._may_dial(endpoint)
        if self._links.hub:
            raise CannotConnect(endpoint=endpoint, reason=_ATTACHED.format(hub=self._links.hub))
        there = self._dial(endpoint)
        if not there:
            raise CannotConnect(endpoint=endpoint, reason=self._why(endpoint))
        with self._lock:
            self._check_open()
            self._kept[endpoint] = there
        self._rounds.by(self._clock.now_ns() + _ROUND_NS)

    def disconnect(self, endpoint: str) -> None:
        """Stop dialling an endpoint; raises LinkStays while the link exists, as only closing an end removes it."""
        Endpoint.read(endpoint)
        with self._lock:
            self._check_open()
            there = self._kept.pop(endpoint, "")
        if (there and self._links.linked(there)) or self._links.linked_at(endpoint):
            raise LinkStays(to=endpoint)

    def _dial(self, endpoint: str) -> str:
        return self._join([endpoint], "")

    def _join(self, endpoints: Sequence[str], session: str) -> str:
        """Link to the session, or to any, at the first of these addresses that has it; returns its id, or nothing."""
        for address in self._attempts.accepting(endpoints):
            joined = self._links.join(address, session, _JOIN_S, self._ended)
            if joined.session or self._closed:
                return joined.session
            self._attempts.note(address, joined.problem)
        return ""

    def attempts(self) -> list[Attempt]:
        """What came of the last try at each address that this container dialled, oldest first; for reports."""
        return self._attempts.listed()

    def dialled(self) -> dict[str, bool]:
        """The endpoints that it dials, and whether a link leads to each."""
        with self._lock:
            endpoints = dict.fromkeys((*self._links.connect, *self._kept))
        return {endpoint: self._links.linked_at(endpoint) for endpoint in endpoints}

    def unlinked(self) -> list[str]:
        """The configured endpoints that no link leads to."""
        return [endpoint for endpoint in self.configured if not self._links.linked_at(endpoint)]

    def try_all(self, endpoints: Sequence[str]) -> None:
        """Tries to reach endpoints, side by side, so that `why_apart` knows what came of each."""
        for _ in self._attempts.accepting([endpoint for endpoint in endpoints if endpoint != self._links.hub]):
            pass

    def why_apart(self, endpoint: str, *, certain: bool) -> str:
        """Why no link leads to an endpoint, by what `try_all` found.

        Args:
            endpoint: a configured endpoint.
            certain: whether the link is known to be missing; otherwise the peer may have dialled this container, which
                is checked for two seconds at most.

        Returns:
            The reason; empty if a link exists.
        """
        if certain or self._links.hub or not any(attempt.accepted for attempt in self._tried(endpoint)):
            return self._why(endpoint)
        return "" if self._dial(endpoint) else self._why(endpoint)

    def _tried(self, endpoint: str) -> list[Attempt]:
        addresses = {endpoint, *Endpoint.read(endpoint).resolved()}
        return [attempt for attempt in self._attempts.listed() if attempt.address in addresses]

    def _why(self, endpoint: str) -> str:
        """Only what is known: each address, what came of it, and what a link takes."""
        if self._links.hub:
            return _NO_LINK if accepts(endpoint) else WITHOUT_HUB
        tried = self._tried(endpoint)
        where = f" (tried {', '.join(map(str, tried))})" if tried else ""
        if tried and not any(attempt.accepted for attempt in tried):
            return f"nothing accepts connections there{where}"
        known = [f"{_NO_LINK}{where}", _NEEDED[self._links.certified]]
        known += [_BRIDGES] if self._links.bridges else []
        return "; ".join(known)

    # --- the task

    def _has_work(self) -> bool:
        return not self._closed and (self._discovering or bool(self._kept) or bool(self._unsure))

    def _round(self) -> float:
        if not self._has_work():
            return NEVER
        for step in (self._discover, self._redial, self._report_refusals):
            try:
                step()
            except Exception:
                if not self._closed:
                    _logger.exception("looking for other containers failed; trying again")
        return self._clock.now_ns() + _ROUND_NS

    def _discover(self) -> None:
        if not self._discovering:
            return
        for found in self._links.scouted(_SCOUT_S, lambda: self._closed or not self._discovering):
            patient = time.monotonic() >= self._refused.get(found.session, 0.0)
            if patient and not self._links.linked(found.session):
                joined = self._join(found.endpoints, found.session)
                if not joined:
                    self._refused[found.session] = time.monotonic() + _AGAIN_S

    def _redial(self) -> None:
        for endpoint, session in self._kept.copy().items():
            if self._links.linked(session) if session else self._links.linked_at(endpoint):
                continue
            there = self._dial(endpoint)
            with self._lock:
                if there and endpoint in self._kept:
                    self._kept[endpoint] = there

    def _report_refusals(self) -> None:
        """Warn once about each configured endpoint that refuses this container; nothing else would report it."""
        self._unsure = [endpoint for endpoint in self._unsure if not self._links.linked_at(endpoint)]
        if time.monotonic() < self._unsure_until:
            return
        silent, self._unsure = self._unsure, []
        for endpoint in silent:
            self.try_all([endpoint])
            if any(attempt.accepted for attempt in self._tried(endpoint)):
                _logger.warning("%s", CannotConnect(endpoint=endpoint, reason=self._why(endpoint)))

    def _ended(self) -> bool:
        return self._closed

    def _check_dials(self, on: bool) -> None:
        self._check_open()
        if on and self._links.hub:
            raise ConfigurationError(where="discovery", problem=_ATTACHED.format(hub=self._links.hub))

    def _check_open(self) -> None:
        if self._closed:
            raise ConfigurationError(problem="the container is closed")

    def close(self) -> None:
        """Dial no more, and end the beacon. Idempotent."""
        with self._lock:
            self._closed = True
            self._end_beacon()
        self._rounds.cancel(_END_S)


_NO_LINK: Final = "no link was made in time"
_NEEDED: Final = {
    False: "a link takes the same user and password at both ends (TRADE_CREDENTIALS)",
    True: (
        "a link takes certificates in date of one authority at both ends, and the peer's has to name the address that "
        "it listens on"
    ),
}
"""By whether this container has a certificate. The other end gives no reason when it refuses."""
_ATTACHED: Final = (
    "this container is attached to the hub of its host at {hub}, which links it to others: let the hub link to them "
    "(TRADE_CONNECT where it runs), or set TRADE_HUB=off for this container"
)
_BRIDGES: Final = "bridges link to each other by connect in their settings only, when they start"
