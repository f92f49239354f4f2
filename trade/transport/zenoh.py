# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUnknownLambdaType=false, reportCallIssue=false
"""The transport on eclipse-zenoh.

No Python runs on zenoh's threads: every subscriber is a channel that our threads read. Puts are sent at once, and wait
for a stalled receiver instead of dropping (zenoh's default). All sessions have the same short lease.
"""

import contextlib
import itertools
import logging
import threading
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import zenoh

from trade._security.certificates import Certificate, transport_settings
from trade.errors import ConfigurationError
from trade.protocol.keys import PASSING
from trade.transport.base import (
    Answer,
    Channel,
    ChannelClosed,
    Message,
    Presence,
    Publisher,
    Question,
    Questions,
    Transport,
)
from trade.transport.endpoints import Endpoint
from trade.transport.session_ids import new_session_id
from trade.transport.timer_slack import read_patiently
from trade.transport.zenoh_links import Links, open_session
from trade.transport.zenoh_prompt import Prompt

_logger = logging.getLogger("trade")

LEASE_MS: Final = 2000
_COMING_IN_MS: Final = 4000
_AGAIN_MS: Final = 200
_AGAIN_AT_LAST_MS: Final = 1000
_MOST_SESSIONS: Final = 10_000
_CHANNEL_CAPACITY: Final = 4096
_MOST_KNOWN_KEYS: Final = 1024
_BLOCK: Final = zenoh.CongestionControl.BLOCK
_DROP: Final = zenoh.CongestionControl.DROP
_CLOSED: Final = (zenoh.ZError, RuntimeError)
"""What zenoh raises for an object that is closed already, or that another thread closes or uses right now."""
_PUT: Final = zenoh.SampleKind.PUT


_SHARED_FROM_BYTES: Final = 32 << 10
"""Larger messages go through shared memory on one host; registry messages of containers are smaller."""


def configuration(
    *,
    namespace: str,
    listen: Sequence[str],
    connect: Sequence[str],
    began_ns: int | None = None,
    credentials: tuple[str, str] | None = None,
    certificate: Certificate | None = None,
    bridge: Sequence[Sequence[str]] = (),
    hub: str = "",
    rules: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """The settings of one session, in zenoh's names.

    ``began_ns`` is when its container entered its host: of two, the later one dials the earlier one, never the reverse.

    ``bridge`` has the interfaces of each network that it joins; an empty list of them stands for all. With ``hub``, its
    endpoint, the only link of the session is that to the hub, which carries everything (`trade.hub_file`).
    Certificates, or else credentials, decide which peers may link; rules decide what those may send (see `zenoh_acl`).
    """
    entry: dict[str, Any] = {} if certificate is None else {"transport/link/tls": transport_settings(certificate)}
    if credentials is not None:
        entry["transport/auth/usrpwd/user"], entry["transport/auth/usrpwd/password"] = credentials
    return {
        "id": new_session_id(began_ns, dials=all(Endpoint.read(own).loopback for own in listen)),
        "mode": "client" if hub else "router" if bridge else "peer",
        "gateway": {"south": [_region(interfaces) for interfaces in bridge]} if bridge else {},
        # A bridge's neighbours are on other hosts; sharing with those on its own host would take 16 MiB for each.
        "transport/shared_memory/enabled": not (bridge or hub),
        "namespace": namespace,
        "listen/endpoints": list(listen),
        "connect/endpoints": [hub] if hub else list(connect),
        # Without a hub -1: 0 would be no retry, and opening waits half a second at most.
        "connect/timeout_ms": _COMING_IN_MS if hub else -1,
        "connect/exit_on_failure": bool(hub),
        "connect/retry": {
            "period_init_ms": _AGAIN_MS,
            "period_max_ms": _AGAIN_MS if hub else _AGAIN_AT_LAST_MS,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        # Two peers that discover each other at once must not both dial: each would refuse the other's second link.
        # A bridge is not announced to its neighbours by gossip; it dials them.
        "scouting/gossip/autoconnect": {"router": ["peer"], "peer": ["router", "peer"]},
        "scouting/gossip/autoconnect_strategy": {
            "peer": {"to_router": "always", "to_peer": "greater-zid"},
            "router": {"to_peer": "always"},
        },
        **entry,
        **rules,
        # The first message above it takes a pool of 16 MiB of locked memory that lives as long as the process.
        "transport/shared_memory/transport_optimization/message_size_threshold": _SHARED_FROM_BYTES,
        # A slow handshake takes one of 100 places; zenoh would leave it there for 10 s.
        "transport/unicast/max_sessions": _MOST_SESSIONS,
        "transport/unicast/accept_timeout": _COMING_IN_MS,
        "transport/unicast/open_timeout": _COMING_IN_MS,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/keep_alive": 4,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000,
    }


def _region(interfaces: Sequence[str]) -> dict[str, Any]:
    """The peers on these interfaces form one network; routers do not belong to it, as they are other bridges."""
    where = {"interfaces": list(interfaces)} if interfaces else {}
    return {"filters": [{"modes": ["peer", "client"], **where}]}


class ZenohChannel(Channel):
    """A subscriber of any of zenoh's three kinds.

    For a few keys that repeat, the keys are declared on the session: zenoh caches the route of a declared key, and
    computes it for every message of any other.
    """

    def __init__(self, subscriber: Any, declare_on: zenoh.Session | None = None) -> None:
        self._subscriber = subscriber
        self._next_recv: Callable[[], zenoh.Sample] | None = None
        """The reader of the next subscriber, used once everything from the previous one has been read."""
        self._closed = False
        self._moving = threading.Lock()
        self._session = declare_on
        self._known: dict[str, zenoh.KeyExpr] = {}
        self._recv = _reader(subscriber)

    def receive(self) -> Message:
        recv = self._recv
        try:
            sample: zenoh.Sample = read_patiently(recv)
        except zenoh.ZError:
            if self._go_on(recv):
                return self.receive()
            raise ChannelClosed from None
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        if self._session is not None and key not in self._known:
            self._learn(self._session, key)
        return Message(key, payload if payload or sample.kind == _PUT else None)

    def _learn(self, session: zenoh.Session, key: str) -> None:
        if len(self._known) >= _MOST_KNOWN_KEYS:
            self._forget(session)
        _quietly(lambda: self._known.setdefault(key, session.declare_keyexpr(key)))

    def _forget(self, session: zenoh.Session) -> None:
        known, self._known = self._known, {}
        for declared in known.values():
            _quietly(lambda declared=declared: session.undeclare(declared))

    def move(self, declare: Callable[[], Any]) -> None:
        """Switch to another subscriber; messages that both have are read twice. Raises ZError for a closed session."""
        with self._moving:
            if self._closed:
                return
            before, self._subscriber = self._subscriber, declare()
            self._next_recv = _reader(self._subscriber)
        _quietly(before.undeclare)

    def _go_on(self, ended: Any) -> bool:
        """Switch to the next subscriber after one has ended; returns whether one exists."""
        with self._moving:
            if self._next_recv is not None:
                self._recv, self._next_recv = self._next_recv, None
            return self._recv is not ended and not self._closed

    def close(self) -> None:
        with self._moving:
            self._closed = True
        _quietly(self._subscriber.undeclare)
        if self._session is not None:
            self._forget(self._session)


def _reader(subscriber: Any) -> Callable[[], zenoh.Sample]:
    return subscriber.handler.recv if hasattr(subscriber, "handler") else subscriber.recv


class ZenohPublisher(Publisher):
    """Publishes under one key of a zenoh session."""

    def __init__(self, publisher: Any, forget: Callable[[], Any]) -> None:
        self._publisher = publisher
        self._forget = forget

    def put(self, payload: bytes) -> None:
        try:
            self._publisher.put(payload)
        except _CLOSED:
            raise ChannelClosed from None

    def close(self) -> None:
        _quietly(self._publisher.undeclare)
        _quietly(self._forget)


class ZenohQuestion(Question):
    """A query that a queryable has received."""

    def __init__(self, query: zenoh.Query) -> None:
        self._query = query
        self._query_key = query.key_expr

    def answer(self, key: str, payload: bytes) -> None:
        if not self._query_key.intersects(key):
            return
        try:
            self._query.reply(key, payload)
        except _CLOSED:
            raise ChannelClosed from None

    def close(self) -> None:
        _quietly(self._query.drop)


class ZenohQuestions(Questions):
    """Received queries, from a queryable of zenoh."""

    def __init__(self, queryable: Any) -> None:
        self._queryable = queryable
        self._recv = queryable.handler.recv  # reading it while another thread closes is refused

    def receive(self) -> Question:
        try:
            return ZenohQuestion(read_patiently(self._recv))
        except zenoh.ZError:
            raise ChannelClosed from None

    def close(self) -> None:
        _quietly(self._queryable.undeclare)


class ZenohPresence(Presence):
    """A sign of life: a liveliness token of zenoh."""

    def __init__(self, token: zenoh.LivelinessToken) -> None:
        self._token = token

    def close(self) -> None:
        _quietly(self._token.undeclare)


class ZenohTransport(Transport):
    """The transport on a zenoh session."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._prompt = Prompt() if Prompt.possible(settings) else None
        more = {} if self._prompt is None else self._prompt.settings(bool(settings["connect/endpoints"]))
        try:
            self._session = open_session({**settings, **more})
        except zenoh.ZError as bad:
            if self._prompt is not None:
                self._prompt.close()
            reason = str(bad).partition(" at /")[0]  # the rest is a line in zenoh's sources
            raise ConfigurationError(
                where=f"listen {', '.join(settings['listen/endpoints'])}",
                problem=f"cannot listen there: {reason}; is the address taken, or not of this host?",
            ) from None
        if self._prompt is not None and not self._prompt.secure():
            _logger.warning("the transport cannot be made to dial: containers whose addresses change may stay unlinked")
        self.links: Final = Links(self._session, settings, self._prompt)
        self.relayed = bool(self.links.hub)
        self.keep_files: Callable[[], None] = lambda: None
        """Writes files on this host again, by which others find this transport, if they have vanished."""
        self._publishers: Final[set[zenoh.Publisher]] = set()
        self._passing: list[tuple[ZenohChannel, Callable[[], Any]]] = []
        """Channels with a temporary pattern, and how to subscribe with the final one once the container stays."""

    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        behind = droppable and not urgent
        priority = zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.BACKGROUND if behind else zenoh.Priority.DATA
        with _refusing():
            known = self._session.declare_keyexpr(key)
            declared = self._session.declare_publisher(
                known, congestion_control=_DROP if droppable else _BLOCK, express=not behind, priority=priority
            )
        self._publishers.add(declared)

        def forget() -> None:
            self._publishers.discard(declared)
            self._session.undeclare(known)

        return ZenohPublisher(declared, forget)

    def subscribe(self, pattern: str, *, newest: int = 0) -> Channel:
        def heard(pattern: str) -> Any:
            return self._session.declare_subscriber(pattern, zenoh.handlers.RingChannel(newest) if newest else _fifo())

        return self._hear(pattern, heard, declare_on=self._session)

    def announce(self, key: str, payload: bytes) -> None:
        with _refusing():
            self._session.put(key, payload, congestion_control=_BLOCK, express=True)

    def announcements(self, pattern: str) -> Channel:
        def heard(pattern: str) -> Any:
            return self._session.declare_subscriber(pattern, _fifo(), allowed_origin=zenoh.Locality.REMOTE)

        return self._hear(pattern, heard)

    def _hear(self, pattern: str, heard: Callable[[str], Any], declare_on: zenoh.Session | None = None) -> ZenohChannel:
        """Short-lived containers subscribe with separate patterns that match the same keys.

        zenoh 1.10 keeps the link to each subscriber of a pattern, 6 KiB and more, for as long as any subscriber of that
        pattern exists (https://github.com/eclipse-zenoh/zenoh/issues/2393).
        """
        with _refusing():
            channel = ZenohChannel(heard(PASSING.get(pattern, pattern)), declare_on)
        if pattern in PASSING:
            self._passing.append((channel, lambda: heard(pattern)))
        return channel

    def settle(self) -> None:
        passing, self._passing = self._passing, []
        with _refusing():
            for channel, heard in passing:
                channel.move(heard)

    def questions(self, pattern: str) -> Questions:
        with _refusing():
            return ZenohQuestions(self._session.declare_queryable(pattern, _fifo()))

    def ask(self, patterns: list[str], timeout_s: float) -> list[Answer]:
        with _refusing():
            queries = [self._query(pattern, timeout_s) for pattern in patterns]
        return _by_replier(itertools.chain.from_iterable(queries))

    def _query(self, pattern: str, timeout_s: float) -> Iterable[zenoh.Reply]:
        return self._session.get(
            pattern,
            _fifo(),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=_BLOCK,
            allowed_destination=zenoh.Locality.REMOTE,
            timeout=timeout_s,
        )

    def appear(self, key: str) -> Presence:
        with _refusing():
            return ZenohPresence(self._session.liveliness().declare_token(key))

    def presences(self, pattern: str) -> Channel:
        with _refusing():
            return ZenohChannel(self._session.liveliness().declare_subscriber(pattern, _fifo(), history=True))

    def present(self, pattern: str, timeout_s: float) -> list[str]:
        with _refusing():
            replies = self._session.liveliness().get(pattern, _fifo(), timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def bridged(self) -> bool:
        return self.links.bridged()

    def bridge_lost(self) -> bool:
        return self.links.bridge_lost()

    def wake(self, key: str, payload: bytes) -> None:
        _quietly(lambda: self._session.put(key, payload, allowed_destination=zenoh.Locality.SESSION_LOCAL))

    def close(self) -> None:
        for publisher in list(self._publishers):  # zenoh 1.10 never frees a session that ends before its publishers
            _quietly(publisher.undeclare)
        _quietly(self._session.close)
        if self._prompt is not None:
            self._prompt.close()


def _by_replier(replies: Iterable[zenoh.Reply]) -> list[Answer]:
    answers: dict[str, Answer] = {}
    for reply in replies:
        if reply.ok is not None:
            who = "" if reply.replier_id is None else str(reply.replier_id.zid)
            answer = answers.setdefault(who, Answer(who, []))
            answer.messages.append(Message(str(reply.ok.key_expr), reply.ok.payload.to_bytes()))
    return list(answers.values())


def _fifo() -> Any:
    return zenoh.handlers.FifoChannel(_CHANNEL_CAPACITY)


@contextlib.contextmanager
def _refusing() -> Generator[None, None, None]:
    """Turns the errors of a closed session into ChannelClosed."""
    try:
        yield
    except zenoh.ZError:
        raise ChannelClosed from None


def _quietly(action: Any) -> None:
    """Run an action unless the session is closed already: closing is idempotent and never fails.

    zenoh releases an object that another thread uses right now when that thread is done.
    """
    try:
        action()
    except _CLOSED:
        return
