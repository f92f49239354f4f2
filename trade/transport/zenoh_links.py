# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Short-lived zenoh sessions next to a container's main one, which link it to others while it runs.

An open zenoh session can neither dial nor answer scouts, and the main one is never reopened. A second session that is
linked to two others introduces them to each other by gossip; the two link, and stay linked when it closes.
"""

import contextlib
import hashlib
import hmac
import json
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, NamedTuple

import zenoh

from trade._security.certificates import authority
from trade.errors import ConfigurationError
from trade.transport.addresses import ACCEPTS
from trade.transport.credentials import dictionary_file
from trade.transport.endpoints import Endpoint, dialled_from_here, loopback_interface
from trade.transport.interfaces import OwnAddress, own_addresses
from trade.transport.scouting import PEER, ROUTER, Beacon, scout
from trade.transport.session_ids import dials_first, new_session_id
from trade.transport.zenoh_prompt import Prompt

_logger = logging.getLogger("trade")

WITHOUT_HUB: Final = (
    "no container is visible from here until it is back; start it again with `trade hub`. Stops and e-stops of this "
    "host work without it"
)
_NO_PEERS: Final[dict[str, Any]] = {"router": [], "peer": []}
_TAG: Final = 16
_NAME: Final = 12
"""Hexadecimal digits. A beacon's id consists of its system's tag, this many digits of the main session's id, and the
port that the main session listens on, so a scout knows which container it found, and dials its main session."""
_LOOK_S: Final = 0.01
_MOMENT_S: Final = 1.0

_USER: Final = "transport/auth/usrpwd/user"
_TLS: Final = "transport/link/tls"
_PASSWORD: Final = "transport/auth/usrpwd/password"  # noqa: S105 - the name of a setting


def open_session(settings: dict[str, Any]) -> zenoh.Session:
    """Open a session with settings in zenoh's names; it accepts peers with its own credentials, or with a certificate
    of its authority. Raises zenoh.ZError.
    """
    if _USER not in settings:
        return zenoh.open(_config(settings))
    with dictionary_file((settings[_USER], settings[_PASSWORD])) as allowed:
        return zenoh.open(_config({**settings, "transport/auth/usrpwd/dictionary_file": str(allowed)}))


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


class FoundContainer(NamedTuple):
    """A discoverable container of this system."""

    session: str
    """The first digits of its main session's id."""
    endpoints: tuple[str, ...]


class LinkAttempt(NamedTuple):
    """What came of an attempt to link."""

    session: str
    """The id of the session that the main one is linked to now; empty: none."""
    problem: str = ""
    """Why not, as far as it is known."""


class _AddressOwner(NamedTuple):
    """Who listens at an address."""

    endpoint: str
    session: str = ""
    kind: int = PEER


class Link(NamedTuple):
    """One link of the main session."""

    session: str
    """The id of the session at its other end."""
    here: str
    """The endpoint of this end."""
    there: str
    """The endpoint of the other end."""
    dialled: bool
    """Whether this end dialled the other one."""
    bridge: bool
    """Whether the other end is a bridge."""


class Links:
    """The links of the main session, and the way to add more."""

    def __init__(self, session: zenoh.Session, settings: dict[str, Any], prompt: Prompt | None = None) -> None:
        self._session = session
        self._settings = settings
        self._prompt = prompt
        self._own = str(session.zid())
        self.bridges: Final[bool] = settings["mode"] == "router"
        self.hub: Final[str] = settings["connect/endpoints"][0] if settings["mode"] == "client" else ""
        """The endpoint of the hub of this host, if the main session is linked to it only; it cannot be dialled then."""
        self.certified: Final = _TLS in settings
        self.listen: Final = [Endpoint.read(text) for text in settings["listen/endpoints"]]
        self.connect: Final = tuple(settings["connect/endpoints"])
        """The endpoints that the main session dials."""
        self._known_at_start = _dialled()
        """The addresses at the start: all that the main session ever announces by gossip."""
        self._known = self._known_at_start
        self._tag = _tag(settings)
        self._reached_at = self.listen or [Endpoint.read(self.hub)]
        self._shown = next((own for own in self._reached_at if not own.loopback), self._reached_at[0])
        self._routers = _routers(session)
        self._router_lost_s = -math.inf
        self._beacon_id = f"{self._tag}{self._own[:_NAME]}{self._shown.port:04x}"

    def bridge_lost(self) -> bool:
        """Whether the main session lost its link to a bridge within the last second, as far as checks have seen."""
        try:
            there = _routers(self._session)
        except zenoh.ZError:  # closed
            return False
        if self._routers - there:
            self._router_lost_s = time.monotonic()
            if self.hub:
                _logger.warning("lost the hub of this host at %s: %s", self.hub, WITHOUT_HUB)
        self._routers = there
        return time.monotonic() - self._router_lost_s < _MOMENT_S

    def bridged(self) -> bool:
        """Whether the main session is linked to a bridge, or was within the last second."""
        return self.bridge_lost() or bool(self._routers)

    def count(self) -> int:
        """The number of links of the main session."""
        try:
            return len(list(self._session.info.transports()))
        except zenoh.ZError:  # closed
            return 0

    def far_ends(self) -> set[str] | None:
        """The endpoints of the far ends of the main session's links, with that of its beacon; None if it is closed."""
        try:
            return {_plain(str(link.dst)) for link in self._session.info.links()}
        except zenoh.ZError:
            return None

    def current(self) -> list[Link] | None:
        """The links of the main session, without those of its own beacon; None if it is closed."""
        try:
            info = self._session.info
            bridges = {str(router) for router in info.routers_zid()}
            found = [(str(link.zid), _plain(str(link.src)), _plain(str(link.dst))) for link in info.links()]
        except zenoh.ZError:
            return None
        ports = tuple(f":{own.port}" for own in self.listen)
        return [
            Link(session, here, there, not here.endswith(ports), session in bridges)
            for session, here, there in found
            if session != self._beacon_id
        ]

    def linked(self, session: str) -> bool:
        """Whether the main session is linked to one whose id begins with this text."""
        try:
            return any(other.startswith(session) for other in _others(self._session))
        except zenoh.ZError:  # closed
            return False

    def interfaces(self, endpoint: str) -> list[str]:
        """The interfaces that reach the main session at one of its endpoints; empty if it is unreachable there."""
        asking = self._beside(endpoint)
        try:
            until = time.monotonic() + _MOMENT_S / 2
            while not (links := list(asking.info.links())) and time.monotonic() < until:
                time.sleep(_LOOK_S)
            return [name for link in links for name in link.interfaces]
        finally:
            _close(asking)

    def linked_at(self, endpoint: str) -> bool:
        """Whether one of the main session's links leads to an endpoint."""
        wanted = set(Endpoint.read(endpoint).resolved())
        try:
            return any(_plain(str(link.dst)) in wanted for link in self._session.info.links())
        except zenoh.ZError:  # closed
            return False

    def beacon(self) -> Beacon:
        """Answers scouts until it is closed, with the addresses at which this host can be dialled at that moment."""
        self._check_here()
        return Beacon(self._beacon_id, self._locators, here_only=self._here_only)

    def _locators(self, known: list[OwnAddress], asker: str) -> list[str]:
        """Where others can dial the main session now, best first for who asks."""
        ips = [own.ip for own in known if own.dialled] or [own.ip for own in known if own.loopback]
        shared = {own.ip for own in known if own.reaches(asker)}
        ips.sort(key=lambda ip: ip not in shared)
        found: list[str] = []
        for own in self.listen:
            hosts = [own.host]
            if own.everywhere:
                hosts = [f"[{ip}]" if ":" in ip else ip for ip in ips if ":" not in ip or ":" in own.host]
            found += [f"{own.protocol}/{host}:{own.port}" for host in hosts]
        return found

    def scouted(self, for_s: float, ended: Callable[[], bool]) -> Iterator[FoundContainer]:
        """Scouts for containers; yields each discoverable container of this system once."""
        self._check_here()
        seen = {self._beacon_id}
        for beacon, locators in scout(for_s, ended, here_only=self._here_only):
            if beacon not in seen and beacon.startswith(self._tag):
                seen.add(beacon)
                with contextlib.suppress(ConfigurationError, ValueError):  # any program may answer
                    yield _found(beacon, locators)

    def join(self, endpoint: str, session: str, wait_s: float, ended: Callable[[], bool]) -> LinkAttempt:
        """Link the main session with the one that listens there.

        Args:
            endpoint: an address, not a name.
            session: the first digits of the id that it must have; empty: any will do.
            wait_s: the time for each of three steps: to ask who listens, to be dialled, and to dial.
            ended: whether to end early.
        """
        there = self._ask_who(endpoint, wait_s, ended)
        if not there.session:
            return LinkAttempt("", f"{ACCEPTS}, but not this container")
        if there.session == self._own:
            return LinkAttempt("", "this container itself")
        if not there.session.startswith(session):
            return LinkAttempt("", f"another container answers now ({there.session[:_NAME]})")
        ways = [self._introduced, self._prompted]
        if (
            self._prompt is not None
            and not self.bridges
            and (self.moved() or there.kind == ROUTER or dials_first(self._own, there.session))
        ):
            ways.reverse()
        for way in ways:
            if self.linked(there.session) or way(there, wait_s, ended):
                return LinkAttempt(there.session)
        return LinkAttempt("", f"{ACCEPTS} and this container, but no link was made in time")

    def moved(self) -> bool:
        """Whether others would dial addresses that this host had when it started, and that are not all of today's."""
        return self._everywhere and _dialled() != self._known_at_start

    @property
    def _everywhere(self) -> bool:
        return any(own.everywhere for own in self.listen)

    def watch_addresses(self) -> None:
        """Logs a change of the addresses at which others dial the main session; called every two seconds."""
        if not self._everywhere:
            return
        before, self._known = self._known, _dialled()
        changes = (("new", self._known - before), ("gone", before - self._known))
        if changed := "; ".join(f"{what} {', '.join(sorted(ips))}" for what, ips in changes if ips):
            _logger.warning(
                "the addresses of this host changed: %s. Those that dial a name, and discovery, find it there", changed
            )

    def _ask_who(self, endpoint: str, wait_s: float, ended: Callable[[], bool]) -> _AddressOwner:
        asking = self._beside(endpoint)
        try:
            until = time.monotonic() + wait_s
            while time.monotonic() < until and not ended():
                if routers := sorted(_routers(asking)):
                    return _AddressOwner(endpoint, routers[0], ROUTER)
                if others := _others(asking):
                    return _AddressOwner(endpoint, others[0])
                time.sleep(_LOOK_S)
            return _AddressOwner(endpoint)
        finally:
            _close(asking)

    def _introduced(self, there: _AddressOwner, wait_s: float, ended: Callable[[], bool]) -> bool:
        """By a session that is linked to both: of the two, the one that dials first dials what the other listened on
        when it started.
        """
        helper = self._beside(self._main_endpoint(), there.endpoint)
        try:
            return self._wait_linked(there, min(wait_s, _MOMENT_S) if self._prompt else wait_s, ended)
        finally:
            _close(helper)

    def _prompted(self, there: _AddressOwner, wait_s: float, ended: Callable[[], bool]) -> bool:
        """By the main session itself, which dials exactly there."""
        if self._prompt is None or not self._prompt.dial(there.session, [there.endpoint], there.kind):
            return False
        return self._wait_linked(there, wait_s, ended)

    def _wait_linked(self, there: _AddressOwner, wait_s: float, ended: Callable[[], bool]) -> bool:
        until = time.monotonic() + wait_s
        while not (linked := self.linked(there.session)) and time.monotonic() < until and not ended():
            time.sleep(_LOOK_S)
        return linked

    def _main_endpoint(self) -> str:
        """The endpoint at which a session of this process reaches the main one, or the hub that it is attached to."""
        return dialled_from_here(self._reached_at[0])

    def _beside(self, *connect: str) -> zenoh.Session:
        settings = {
            **self._settings,
            "id": new_session_id(),
            "mode": "peer",
            "gateway": {},
            "listen/endpoints": [],
            "connect/endpoints": list(connect),
            "scouting/gossip/autoconnect": _NO_PEERS,
            "open/return_conditions/connect_scouted": False,
        }
        try:
            return open_session(settings)
        except zenoh.ZError as bad:
            raise ConfigurationError(
                where="the extra session for discovery and joining", problem=f"cannot be opened: {bad}"
            ) from None

    @property
    def _here_only(self) -> bool:
        return all(own.loopback for own in self.listen)

    def _check_here(self) -> None:
        """S21: a container that listens on this host only scouts and answers on this host only."""
        if self._here_only and not loopback_interface():
            problem = "no loopback interface was found, and this container may not be found from other hosts"
            raise ConfigurationError(where="discovery", problem=problem)


def _routers(session: zenoh.Session) -> set[str]:
    return {str(router) for router in session.info.routers_zid()}


def _others(session: zenoh.Session) -> list[str]:
    """The ids of the sessions that a session is linked to."""
    return [str(other) for other in (*session.info.peers_zid(), *session.info.routers_zid())]


def _dialled() -> set[str]:
    """The addresses of this host that others can dial."""
    return {own.ip for own in own_addresses() if own.dialled}


def _close(extra: zenoh.Session) -> None:
    """Close a session beside the main one. Over a network that just went away it takes 10 s; waits 1 s at most."""

    def close() -> None:
        with contextlib.suppress(zenoh.ZError):
            extra.close()

    closing = threading.Thread(target=close, name="trade-link-end", daemon=True)
    closing.start()
    closing.join(_MOMENT_S)


def _found(beacon: str, locators: Iterable[str]) -> FoundContainer:
    port = int(beacon[_TAG + _NAME :], 16)
    endpoints = (Endpoint.read(locator)._replace(port=port) for locator in locators)
    return FoundContainer(beacon[_TAG:][:_NAME], tuple(map(str, endpoints)))


def _tag(settings: dict[str, Any]) -> str:
    """The prefix of the ids of one system's beacons; without the system's password, or its authority's certificate, the
    system cannot be identified from it.
    """
    known = authority(settings[_TLS]) if _TLS in settings else str(settings[_PASSWORD]).encode()
    digest = hmac.digest(known, str(settings["namespace"]).encode(), hashlib.sha256).hex()
    return "b" + digest[: _TAG - 1]


def _plain(locator: str) -> str:
    return locator.split("?", maxsplit=1)[0].split("#", maxsplit=1)[0]
