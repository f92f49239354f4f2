"""Samples services while they have listeners: the source's side of streams.

Whatever the number of listeners, a service is called once a tick, its result encoded once, and sent once per rate.
"""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from msgspec import Struct, structs

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.call_context import CallContext
from trade._registry.registry import Change
from trade._services.local_service import LocalService
from trade._services.serial_queue import Turn
from trade._streams.rate import ActiveRate, Rate, period_ns
from trade._threads.scheduler import Scheduler
from trade.errors import AccessDenied, ConfigurationError, DeadlineExceeded, ServiceGone
from trade.protocol.keys import ServiceKey
from trade.protocol.messages import EMPTY_ARGUMENTS, encode_message
from trade.protocol.samples import STEPS_HZ, stream_key
from trade.transport.base import ChannelClosed, Transport

_logger = logging.getLogger("trade")

LEAST_HZ: Final = 0.001
MOST_HZ: Final = 1000.0
LEASE_S: Final = 10.0
"""A listener that has not renewed its request for this long counts as gone."""
_PATIENCE_S: Final = 10.0
"""How long a sample may take."""
_MOST: Final = 10_000
"""The largest number of listeners of one service."""
_MOST_RATES: Final = 64
"""The largest number of different rates of one service."""

Listener = tuple[str, str]
"""Session and name."""


class ListenerInfo(Struct, frozen=True, kw_only=True):
    """One listener of a stream."""

    container: str
    """The container of the service."""
    service: str
    """Group and name: ``rosie.head.state``."""
    session: str
    """The session of the listener."""
    identity: str
    hz: float
    """The highest rate that it takes, in samples per second."""
    on_change: bool
    """Whether it takes only samples that differ from the one before."""
    left_s: float
    """The time until it counts as gone, unless it renews its request."""


class RateRequest(Struct, frozen=True):
    """The request of one listener."""

    identity: str
    hz: float
    on_change: bool
    until_ns: int = 0
    """The end of its lease."""


class Source:
    """A service of this container with or without listeners. Run by the scheduler: never twice at once."""

    def __init__(
        self,
        key: ServiceKey,
        services: Callable[[ServiceKey], LocalService | None],
        transport: Transport,
        new_id: Callable[[], int],
        callback: Callable[[ServiceKey, Listener, bool], None] = lambda _key, _listener, _came: None,
    ) -> None:
        self._key = key
        self._services = services
        self._transport = transport
        self._new_id = new_id
        self._tell = callback
        """Called with each listener that comes (True) or goes."""
        self._shown = ExitStack()
        self._lock = threading.Lock()
        self._requests: dict[Listener, RateRequest] = {}
        self._new: set[float] = set()
        """Rates at which a listener wants a sample at once."""
        self._rates: dict[float, Rate] = {}
        self._next_ns = 0
        self._problem = ""

    def show(self) -> None:
        """Publish the signs that show listeners which rates reach them."""
        for hz in STEPS_HZ:
            self._shown.callback(self._transport.appear(stream_key(self._key, hz)).close)

    def request(self, listener: Listener, request: RateRequest) -> bool:
        """Add or renew a listener; returns whether its request has changed.

        Raises:
            ConfigurationError: too many listeners, or too many rates.
        """
        where = f"{self._key.domain}.{self._key.name}"
        with self._lock:
            before = self._requests.get(listener)
            if before is None and len(self._requests) >= _MOST:
                raise ConfigurationError(where=where, problem=f"it has {_MOST} listeners already")
            rates = {other.hz for other in self._requests.values()}
            if request.hz not in rates and len(rates) >= _MOST_RATES:
                problem = f"it is sampled at {_MOST_RATES} different rates already; ask for one of {sorted(rates)}"
                raise ConfigurationError(where=where, problem=problem)
            self._requests[listener] = request
            new = before is None or (before.hz, before.on_change) != (request.hz, request.on_change)
            if new:
                self._new.add(request.hz)
        if before is None:
            self._tell(self._key, listener, True)
        return new

    def drop(self, which: Callable[[Listener, RateRequest], bool]) -> None:
        """Remove listeners."""
        with self._lock:
            gone = [who for who, request in self._requests.items() if which(who, request)]
            for who in gone:
                del self._requests[who]
        for who in gone:
            self._tell(self._key, who, False)

    def requests(self) -> dict[Listener, RateRequest]:
        """The requests by listener."""
        with self._lock:
            return dict(self._requests)

    def identities(self) -> set[str]:
        """The identities of the listeners."""
        with self._lock:
            return {request.identity for request in self._requests.values()}

    def tick(self) -> int | None:
        """Sample the service if it has listeners; returns the time of the next tick."""
        now = time.monotonic_ns()
        self.drop(lambda _, request: request.until_ns <= now)
        service = self._services(self._key)
        requested = {} if service is None else self._rates_requested()
        try:
            self._keep_only(requested)
            if service is None or not requested:
                self._next_ns = 0
                return None
            every_ns = period_ns(max(requested))
            at, at_ns = time.time(), time.monotonic_ns()
            answer = self._sampled(service, now)
            for hz, how in requested.items():
                self._rates[hz].offer(answer, at, at_ns, how, every_ns)
        except ChannelClosed:
            return None
        return self._after(now, every_ns)

    def _rates_requested(self) -> dict[float, ActiveRate]:
        """The combined requests by rate."""
        with self._lock:
            new, self._new = self._new, set[float]()
            always = {request.hz for request in self._requests.values() if not request.on_change}
            return {
                request.hz: ActiveRate(request.hz in always, request.hz in new) for request in self._requests.values()
            }

    def _keep_only(self, requested: dict[float, ActiveRate]) -> None:
        """Publish at these rates only."""
        for hz in [hz for hz in self._rates if hz not in requested]:
            self._rates.pop(hz).close()
        for hz in requested:
            if hz not in self._rates:
                self._rates[hz] = Rate(hz, self._transport.publish(stream_key(self._key, hz), droppable=True))

    def _after(self, now: int, period_ns: int) -> int:
        """The time of the next tick; missed ones are left out, and an extra tick shifts no others."""
        self._next_ns = min(self._next_ns or now, now + period_ns)
        ended = time.monotonic_ns()
        if self._next_ns <= ended:
            self._next_ns += ((ended - self._next_ns) // period_ns + 1) * period_ns
        return self._next_ns

    def _sampled(self, service: LocalService, now: int) -> tuple[bool, bytes]:
        """Whether the service failed, and its result: called as by its own container, with its own locks and queue."""
        own = self._key.address
        until_ns = now + int(_PATIENCE_S * 1e9)
        context = CallContext(self._new_id(), service.label, own.identity, str(own), until_ns)
        try:
            answer = service.signature.encode_result(service.label, _in_turn(service, context))
        except BaseException as error:  # noqa: BLE001 - every error of a provider goes to the listeners
            info = structs.replace(service.failure(error, EMPTY_ARGUMENTS), traceback="")
            if info.type != self._problem:  # the same error again is not news
                _logger.warning("%s fails while it is listened to: %s: %s", service.label, info.type, info.message)
            self._problem = info.type
            return True, encode_message(info)
        self._problem = ""
        return False, answer

    def close(self) -> None:
        """Stop sampling; the last tick releases the keys. Idempotent."""
        self.drop(lambda _listener, _request: True)
        self._shown.close()


def _in_turn(service: LocalService, context: CallContext) -> object:
    if service.serial is None:
        return service.run(EMPTY_ARGUMENTS, context)
    if not service.serial.enter(Turn(), _PATIENCE_S):
        raise DeadlineExceeded(service=service.label, deadline_s=_PATIENCE_S)
    try:
        with service.serial.held():
            return service.run(EMPTY_ARGUMENTS, context)
    finally:
        service.serial.leave()


class Streams:
    """Owns the sources of one container."""

    def __init__(
        self,
        client: CallClient,
        transport: Transport,
        services: Callable[[ServiceKey], LocalService | None],
        scheduler: Scheduler,
        new_id: Callable[[], int],
    ) -> None:
        self._client = client
        self._transport = transport
        self._services = services
        self._scheduler = scheduler
        self._new_id = new_id
        self._lock = threading.Lock()
        self._sources: dict[ServiceKey, tuple[Source, Callable[[int], None]]] = {}
        self.notify: Callable[[ServiceKey, Listener, bool], None] = lambda _key, _listener, _came: None
        """Called with each listener that comes (True) or goes."""

    def listen(self, handle: Handle, listener: Listener, request: RateRequest) -> None:
        """Sample a service of this container for a listener, for as long as the lease.

        Raises:
            AccessDenied: the policy does not let the listener read the service.
            ConfigurationError: not a service of this container that can be sampled.
            ServiceGone: it was deregistered.
        """
        key = handle.key
        service = self._services(key)
        if key.address != self._client.address:
            raise ConfigurationError(
                where=handle.label, problem=f"it is not a service of container {self._client.name}"
            )
        if service is None:
            raise ServiceGone(service=handle.label)
        check_sampled(handle)
        self._client.require_call(request.identity, handle)
        source, again = self._source(key)
        until_ns = time.monotonic_ns() + int(LEASE_S * 1e9)
        in_key = float(f"{request.hz:g}")  # smaller differences are one rate
        if source.request(listener, structs.replace(request, hz=in_key, until_ns=until_ns)):
            again(time.monotonic_ns())

    def _source(self, key: ServiceKey) -> tuple[Source, Callable[[int], None]]:
        known = self._sources.get(key)
        if known is not None:
            return known
        made = Source(key, self._services, self._transport, self._new_id, self.notify)
        with self._lock:
            known = self._sources.get(key)
            if known is None:
                due = self._scheduler.due(made.tick)
                known = self._sources[key] = (made, due.at)
        if known[0] is made:
            made.show()
        return known

    def listeners(self) -> list[ListenerInfo]:
        """The listeners of this container's services."""
        with self._lock:
            sources = list(self._sources.items())
        now_ns = time.monotonic_ns()
        return [
            ListenerInfo(
                container=self._client.name,
                service=self._client.handle(key).label,
                session=session,
                identity=request.identity,
                hz=request.hz,
                on_change=request.on_change,
                left_s=max(0.0, (request.until_ns - now_ns) / 1e9),
            )
            for key, (source, _) in sources
            for (session, _), request in source.requests().items()
        ]

    def unlisten(self, listener: Listener) -> None:
        """Remove a listener."""
        self._drop(lambda known, _request: known == listener)

    def session_ended(self, session: str) -> None:
        """Remove the listeners of a session that ended."""
        self._drop(lambda listener, _request: listener[0] == session)

    def recheck_access(self) -> None:
        """Drop the listeners that may no longer read a service; they are refused when they renew."""
        with self._lock:
            sources = list(self._sources.items())
        for key, (source, _) in sources:
            denied = {identity for identity in source.identities() if self._denied(identity, key)}
            source.drop(lambda _, request, denied=denied: request.identity in denied)

    def _denied(self, identity: str, key: ServiceKey) -> bool:
        try:
            self._client.require_call(identity, self._client.handle(key))
        except (AccessDenied, ServiceGone):
            return True
        return False

    def _drop(self, which: Callable[[Listener, RateRequest], bool]) -> None:
        with self._lock:
            sources = list(self._sources.values())
        for source, _ in sources:
            source.drop(which)

    def changed(self, change: Change) -> None:
        """Called by the registry."""
        for record in change.left:
            with self._lock:
                gone = self._sources.pop(record.key, None) if record.local else None
            if gone is not None:
                gone[0].close()

    def close(self) -> None:
        """Stop all sampling. Idempotent."""
        with self._lock:
            sources = list(self._sources.values())
            self._sources.clear()
        for source, _ in sources:
            source.close()


def check_sampled(handle: Handle) -> None:
    """Raises ConfigurationError: the service cannot be sampled."""
    info = handle.record.info
    if info.effect != "read":
        problem = f"it does not only read (effect={info.effect!r}), so it cannot be called repeatedly for listeners"
        raise ConfigurationError(where=handle.label, problem=problem)
    required = [parameter.name for parameter in info.parameters if parameter.required]
    if required:
        problem = f"it needs {', '.join(required)}; only a service without required arguments can be listened to"
        raise ConfigurationError(where=handle.label, problem=problem)
