# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Short-lived zenoh sessions next to a container's main one, which link it to others while it runs.

An open zenoh session can neither dial nor answer scouts, and the main one is never reopened. A second session that is
linked to two others introduces them to each other by gossip; the two link, and stay linked when it closes.
"""

import hashlib
import hmac
import json
import logging
import math
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import zenoh

from trade._security.certificates import authority
from trade._transport.credentials import dictionary_file
from trade._transport.endpoints import Endpoint, dialled_from_here, loopback_interface
from trade.errors import ConfigurationError

_logger = logging.getLogger("trade")

WITHOUT_HUB: Final = (
    "no container is visible from here until it is back; start it again with `trade hub`. Stops and e-stops of this "
    "host work without it"
)
_NO_PEERS: Final[dict[str, Any]] = {"router": [], "peer": []}
_DIGITS: Final = 32
_TAG: Final = 16
_NAME: Final = 12
"""Hexadecimal digits. A beacon's id consists of its system's tag, this many digits of the main session's id, and the
port that the main session listens on, so a scout knows which container it found, and dials its main session."""
_LOOK_S: Final = 0.01
_MOMENT_S: Final = 1.0

_USER: Final = "transport/auth/usrpwd/user"
_TLS: Final = "transport/link/tls"
_PASSWORD: Final = "transport/auth/usrpwd/password"  # noqa: S105 - the name of a setting


def new_session_id(*, dials: bool = False) -> str:
    """An id that zenoh keeps as it is written: its first digit is not zero.

    Of two sessions that discover each other the one with the greater id dials; zenoh compares the last byte first. A
    session that listens on this host only can dial others but cannot be dialled from elsewhere: its id is the greater.
    """
    digits = secrets.token_hex(_DIGITS // 2)
    return f"{secrets.choice('123456789abcdef')}{digits[1:-2]}{secrets.randbelow(128) + 128 * dials:02x}"


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


class Beacon:
    """Answers scouts until it is closed."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def close(self) -> None:
        self._session.close()


class Found(NamedTuple):
    """A discoverable container of this system."""

    session: str
    """The first digits of its main session's id."""
    endpoints: tuple[str, ...]


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

    def __init__(self, session: zenoh.Session, settings: dict[str, Any]) -> None:
        self._session = session
        self._settings = settings
        self._own = str(session.zid())
        self.bridges: Final[bool] = settings["mode"] == "router"
        self.hub: Final[str] = settings["connect/endpoints"][0] if settings["mode"] == "client" else ""
        """The endpoint of the hub of this host, if the main session is linked to it only; it cannot be dialled then."""
        self.certified: Final = _TLS in settings
        self.listen: Final = [Endpoint.read(text) for text in settings["listen/endpoints"]]
        self.connect: Final[tuple[str, ...]] = tuple(settings["connect/endpoints"])
        """The endpoints that the main session dials."""
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
        asking = self._beside([], [endpoint], {})
        try:
            return [name for link in asking.info.links() for name in link.interfaces]
        finally:
            asking.close()

    def linked_at(self, endpoint: str) -> bool:
        """Whether one of the main session's links leads to an endpoint."""
        wanted = set(Endpoint.read(endpoint).resolved())
        try:
            return any(_plain(str(link.dst)) in wanted for link in self._session.info.links())
        except zenoh.ZError:  # closed
            return False

    def beacon(self) -> Beacon:
        """Opens a session, linked to the main one, that answers scouts and does not dial, until it is closed."""
        listen = str(self._shown._replace(port=0))
        return Beacon(self._beside([listen], [self._main_endpoint()], {**self._scouting(), "id": self._beacon_id}))

    def scouted(self, for_s: float, ended: Callable[[], bool]) -> Iterator[Found]:
        """Scouts for containers; yields each discoverable container of this system once."""
        seen = {self._beacon_id}
        asking = zenoh.scout(zenoh.handlers.FifoChannel(256), what="peer", config=_config(self._scouting()))
        try:
            until = time.monotonic() + for_s
            while time.monotonic() < until and not ended():
                hello = asking.try_recv()
                if hello is None:
                    time.sleep(_LOOK_S)
                    continue
                found = str(hello.zid)
                if found not in seen and found.startswith(self._tag):
                    seen.add(found)
                    yield _found(found, map(str, hello.locators))
        finally:
            asking.stop()

    def join(self, endpoints: Sequence[str], session: str, wait_s: float, ended: Callable[[], bool]) -> str:
        """Link the main session with the one whose id begins with ``session``, or else with any listener there.

        Returns:
            The id of the session it is linked to now; empty if none accepts it within ``wait_s``.
        """
        helper = self._beside([], [self._main_endpoint(), *endpoints], {})
        try:
            until = time.monotonic() + wait_s
            while time.monotonic() < until and not ended():
                there = session or next((p for p in _others(helper) if p != self._own), "")
                if there and self.linked(there):
                    return there
                time.sleep(_LOOK_S)
            return ""
        finally:
            helper.close()

    def _main_endpoint(self) -> str:
        """The endpoint at which a session of this process reaches the main one, or the hub that it is attached to."""
        return dialled_from_here(self._reached_at[0])

    def _beside(self, listen: Sequence[str], connect: Sequence[str], more: dict[str, Any]) -> zenoh.Session:
        settings = {
            **self._settings,
            "id": new_session_id(),
            "mode": "peer",
            "gateway": {},
            "listen/endpoints": list(listen),
            "connect/endpoints": list(connect),
            "scouting/gossip/autoconnect": _NO_PEERS,
            **more,
        }
        try:
            return open_session(settings)
        except zenoh.ZError as bad:
            raise ConfigurationError(
                where="the extra session for discovery and joining", problem=f"cannot be opened: {bad}"
            ) from None

    def _scouting(self) -> dict[str, Any]:
        return {
            "scouting/multicast/enabled": True,
            "scouting/multicast/listen": True,
            "scouting/multicast/autoconnect": _NO_PEERS,
            "scouting/multicast/interface": self._interface(),
        }

    def _interface(self) -> str:
        """S21: a container that listens on this host only scouts and answers on this host only."""
        if not all(own.loopback for own in self.listen):
            return "auto"
        loopback = loopback_interface()
        if not loopback:
            problem = "no loopback interface was found, and this container may not be found from other hosts"
            raise ConfigurationError(where="discovery", problem=problem)
        return loopback


def _routers(session: zenoh.Session) -> set[str]:
    return {str(router) for router in session.info.routers_zid()}


def _others(session: zenoh.Session) -> list[str]:
    """The ids of the sessions that a session is linked to."""
    return [str(other) for other in (*session.info.peers_zid(), *session.info.routers_zid())]


def _found(beacon: str, locators: Iterable[str]) -> Found:
    port = int(beacon[_TAG + _NAME :], 16)
    endpoints = (Endpoint.read(locator)._replace(port=port) for locator in locators)
    return Found(beacon[_TAG:][:_NAME], tuple(map(str, endpoints)))


def _tag(settings: dict[str, Any]) -> str:
    """The prefix of the ids of one system's beacons; without the system's password, or its authority's certificate, the
    system cannot be identified from it.
    """
    known = authority(settings[_TLS]) if _TLS in settings else str(settings[_PASSWORD]).encode()
    digest = hmac.digest(known, str(settings["namespace"]).encode(), hashlib.sha256).hex()
    return "b" + digest[: _TAG - 1]


def _plain(locator: str) -> str:
    return locator.split("?", maxsplit=1)[0].split("#", maxsplit=1)[0]
