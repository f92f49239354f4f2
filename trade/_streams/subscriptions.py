"""The streams that one container receives: a subscription and a thread for each, which renews its request.

Gateways on the way may forward lower rates only. The signs that arrive show a listener which rates pass, and it
requests no more than those.
"""

import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Final

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._calls.target import container_closed, result_decoder
from trade._context.sessions import Session
from trade._registry.registry import Change
from trade._streams.stream import If, Stream
from trade._threads.scheduler import Scheduler
from trade.errors import AccessDenied, ServiceGone, SessionEnded, SourceLost, TradeError
from trade.protocol.codec import Codec
from trade.protocol.keys import DOMAIN, PROVIDER, ServiceKey
from trade.protocol.messages import Malformed
from trade.protocol.samples import STEPS_HZ, decode_sample, rate_of, signs_of, stream_key
from trade.transport.base import Channel, ChannelClosed, Transport

_logger = logging.getLogger("trade")

AGAIN_S: Final = 2.0
"""How often a listener renews its request: often enough for the source's lease, and for a quick return."""
_DEADLINE_S: Final = 5.0
_SIGNS_S: Final = 1.0
_RING: Final = 64
"""The least number of messages kept while the whole process is suspended."""


class _Subscription:
    """The subscription of one stream, and its requests to the source."""

    def __init__(
        self,
        client: CallClient,
        stream: Stream,
        transport: Transport,
        keep: int,
        scheduler: Scheduler,
        malformed: Callable[[Malformed], None],
    ) -> None:
        self._client = client
        self._stream = stream
        self._transport = transport
        self._keep = keep
        self._wanted_hz = stream.hz
        self._channel = self._subscribe(stream.hz)
        self._lock = threading.Lock()
        self._closed = False
        self._malformed = malformed
        self._due = scheduler.due(self._again)
        self._thread = threading.Thread(target=self._read, name="trade-stream", daemon=True)

    def _subscribe(self, hz: float) -> Channel:
        return self._transport.subscribe(stream_key(self._stream.source.key, hz), newest=self._keep)

    def begin(self) -> None:
        """Request samples from the source, and receive them. Raises the source's errors."""
        try:
            self._ask()
        except BaseException:
            self._channel.close()
            raise
        self._thread.start()
        self._due.at(time.monotonic_ns() + int(AGAIN_S * 1e9))

    def ask_now(self) -> None:
        """The source is reachable again."""
        self._due.at(time.monotonic_ns())

    def _ask(self) -> None:
        stream = self._stream
        self._client.require_call(self._client.address.identity, stream.source)
        with self._speaking():
            self._function("listen")(stream.name, stream.source, stream.hz, stream.on_change)
            passing = self._passing_hz()
            if passing != stream.hz:
                self._change_to(passing)
                self._function("listen")(stream.name, stream.source, stream.hz, stream.on_change)

    def _passing_hz(self) -> float:
        """The requested rate, or the highest one that gateways let pass; unchanged if no sign has arrived."""
        wanted = self._wanted_hz
        if not self._transport.bridged():
            return wanted
        signs = self._transport.present(signs_of(self._stream.source.key), _SIGNS_S)
        passing = sorted(map(rate_of, signs))
        if not passing or passing[-1] == STEPS_HZ[-1]:
            return wanted if passing else self._stream.hz
        return max((hz for hz in passing if hz <= wanted), default=min(wanted, passing[0]))

    def _change_to(self, hz: float) -> None:
        channel = self._subscribe(hz)
        with self._lock:
            if not self._closed:
                self._channel, channel = channel, self._channel
                self._stream.at_rate(hz)
        channel.close()

    def _function(self, name: str) -> Handle:
        key = ServiceKey(self._stream.source.key.address, DOMAIN, PROVIDER, name)
        return self._client.handle(key).with_(deadline_s=_DEADLINE_S)

    def _speaking(self) -> AbstractContextManager[object]:
        opened_by = self._stream.opened_by
        return contextlib.nullcontext() if opened_by is None else opened_by.use()

    def _again(self) -> int | None:
        if self._stream.ended:
            return None
        if self._stream.source.alive:  # else the registry will report it
            try:
                self._ask()
            except (AccessDenied, SessionEnded) as error:
                self._stream.end(error)
                return None
            except (TradeError, ChannelClosed) as error:  # perhaps lost in transit: next time
                _logger.debug("the request for %r was not renewed: %s", self._stream, error)
        return time.monotonic_ns() + int(AGAIN_S * 1e9)

    def _read(self) -> None:
        while True:
            channel = self._channel
            try:
                self._stream.hear(decode_sample(channel.receive().payload or b""))
            except ChannelClosed:
                with self._lock:
                    if channel is self._channel:
                        return
            except Malformed as bad:
                self._malformed(bad)

    def close(self) -> None:
        """Stop listening, and inform the source if it is reachable; otherwise its lease expires."""
        self._due.cancel()
        with self._lock:
            self._closed = True
        self._channel.close()
        with contextlib.suppress(TradeError, ChannelClosed), self._speaking():
            if self._stream.source.alive:
                self._function("unlisten").start(self._stream.name)
        if self._thread is not threading.current_thread() and self._thread.ident is not None:
            self._thread.join(2)


class Subscriptions:
    """Owns the streams that one container has opened."""

    def __init__(
        self,
        client: CallClient,
        transport: Transport,
        scheduler: Scheduler,
        codec: Codec,
        removed: Callable[[ServiceKey], bool],
    ) -> None:
        self._client = client
        self._transport = transport
        self._scheduler = scheduler
        self._codec = codec
        self._removed = removed
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._subscriptions: dict[str, tuple[Stream, _Subscription]] = {}
        self.malformed = 0
        """The number of invalid samples."""

    def open(
        self, source: Handle, hz: float, *, on_change: bool, if_: If | None, keep: int, opened_by: Session | None
    ) -> Stream:
        """Open a stream: subscribes before it requests, so that no sample is missed. Raises the source's errors."""
        stream = Stream(
            f"{self._client.address.epoch}.s{next(self._numbers)}",
            source,
            hz,
            result_decoder(self._codec, source.record.info),
            on_change=on_change,
            if_=if_,
            keep=keep,
            opened_by=opened_by,
            ended=self._ended,
        )
        try:
            newest = max(keep, _RING)
            ear = _Subscription(self._client, stream, self._transport, newest, self._scheduler, self._note_malformed)
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self._client.address) from None
        with self._lock:
            self._subscriptions[stream.name] = (stream, ear)
        try:
            ear.begin()
        except BaseException as error:
            with self._lock:
                self._subscriptions.pop(stream.name, None)
            if isinstance(error, ChannelClosed):
                raise container_closed(self._client.address) from None
            raise
        return stream

    def _ended(self, stream: Stream) -> None:
        """Called by a stream."""
        with self._lock:
            _, ear = self._subscriptions.pop(stream.name, (stream, None))
        if ear is not None:
            ear.close()

    def _note_malformed(self, bad: Malformed) -> None:
        self.malformed += 1
        if self.malformed == 1:
            _logger.warning("dropped a sample: %s (further ones are counted, not logged)", bad)

    def changed(self, change: Change) -> None:
        """Called by the registry."""
        if not self._subscriptions:
            return
        came, went = {record.key for record in change.joined}, {record.key for record in change.left}
        for stream, ear in self._all():
            key, label = stream.source.key, stream.source.label
            if key in came:
                ear.ask_now()
            elif key in went and self._removed(key):
                stream.end(ServiceGone(service=label))
            elif key in went:
                stream.lost(SourceLost(service=label, container=key.address.container))

    def session_ended(self, session: str) -> None:
        """End the streams that were opened in a session."""
        for stream, _ in self._all():
            stream.session_ended(session)

    def close(self) -> None:
        """End all. Idempotent."""
        for stream, _ in self._all():
            stream.end(container_closed(self._client.address))

    def _all(self) -> list[tuple[Stream, _Subscription]]:
        with self._lock:
            return list(self._subscriptions.values())
