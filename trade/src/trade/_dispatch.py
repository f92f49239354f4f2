"""The callee's side of a call: threads that read calls, check, run the provider, answer.

Leader and followers: the threads that run providers are the ones that wait for calls, so a call changes hands nowhere.
The last idle one that takes a call starts another; at the cap it answers Busy, so that the channel is always drained.
"""

import asyncio
import inspect
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from msgspec import Raw

from trade._context import CallContext, running
from trade._failures import pack_error
from trade._signature import Codec, Signature
from trade._transport import Channel, ChannelClosed, Message, Publisher, Transport
from trade._wire import (
    EMPTY,
    PROTOCOL,
    Address,
    Call,
    Malformed,
    Reply,
    Status,
    calls_to,
    decode_call,
    encode_message,
    is_chunk,
    reply_key,
)
from trade.errors import DeadlineExceeded

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 64
_MOST_REPLY_KEYS: Final = 1024


class LocalService:
    """A method of a registered provider, ready to be called."""

    __slots__ = ("effect", "label", "method", "signature")

    def __init__(self, label: str, signature: Signature, method: Callable[..., Any], effect: str) -> None:
        self.label = label
        self.signature = signature
        self.method = method
        self.effect = effect

    def run(self, raw: Raw, context: CallContext) -> Any:
        """Validate, then call. Raises what the provider raises."""
        args, kwargs = self.signature.decode(raw)
        token = running.set(context)
        try:
            result = self.method(*args, **kwargs)
            return _complete(result, context) if inspect.iscoroutine(result) else result
        finally:
            running.reset(token)

    def too_late(self, expires_ns: int | None) -> bool:
        """Whether running it now would be running it late; a stop is never late, a command of unknown expiry always."""
        if self.effect == "stop":
            return False
        if expires_ns is None:
            return self.effect != "read"
        return time.monotonic_ns() >= expires_ns


class _Loop:
    """The event loop on which ``async def`` services run, started by the first of them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    def get(self) -> asyncio.AbstractEventLoop:
        with self._lock:
            if self._loop is None:
                self._loop = asyncio.new_event_loop()
                self._thread = threading.Thread(target=self._loop.run_forever, name="trade-async", daemon=True)
                self._thread.start()
            return self._loop

    def close(self) -> None:
        with self._lock:
            loop, thread = self._loop, self._thread
            self._loop = self._thread = None
        if loop is not None and thread is not None:
            loop.call_soon_threadsafe(loop.stop)
            thread.join(2)
            loop.close()


_loop: Final = _Loop()
close_loop: Final = _loop.close


def _complete(coroutine: Any, context: CallContext) -> Any:
    """Run an ``async def`` service from a handler thread; its deadline cancels it."""
    future = asyncio.run_coroutine_threadsafe(coroutine, _loop.get())
    try:
        return future.result(context.remaining_s)
    except TimeoutError:
        if not future.done():
            future.cancel()
        raise


Lookup = Callable[[str, str], LocalService | None]


class Dispatcher:
    """Every incoming call of one container."""

    def __init__(self, transport: Transport, own: Address, codec: Codec, lookup: Lookup) -> None:
        self._transport = transport
        self._own = own
        self._codec = codec
        self._lookup = lookup
        self._repliers: dict[str, Publisher] = {}
        self._lock = threading.Lock()
        self._closed = False
        self.malformed = 0
        self._crews = [
            _Crew("trade-call", transport.subscribe(calls_to(own, stop=False)), self._serve, self._busy),
            _Crew("trade-stop", transport.subscribe(calls_to(own, stop=True)), self._serve, self._serve),
        ]

    @property
    def draining(self) -> bool:
        """Whether some thread stands ready to take the next call."""
        return all(crew.draining for crew in self._crews)

    def _serve(self, message: Message) -> None:
        call = self._decode(message)
        if call is None:
            return
        _, caller, _, _, _, _, provider = message.key.split("/", 6)
        service = self._lookup(provider, call.service)
        if service is None or (service.effect == "stop") is not message.key.startswith("stop/"):
            self._answer(caller, call, Status.GONE)
        elif service.too_late(call.expires_ns):
            self._answer(caller, call, Status.EXPIRED)
        else:
            self._run(caller, call, service)

    def _run(self, caller: str, call: Call, service: LocalService) -> None:
        expires = None if service.effect == "stop" else call.expires_ns
        context = CallContext(call.id, service.label, caller, call.session, expires, call.chain)
        try:
            result = service.run(call.args, context)
            body, status = service.signature.encode_result(result), Status.OK
        except DeadlineExceeded:
            body, status = EMPTY, Status.EXPIRED
        except Exception as error:  # noqa: BLE001 - whatever a provider raises belongs to the caller
            body, status = Raw(encode_message(pack_error(error))), Status.ERROR
        self._answer(caller, call, status, body)

    def _busy(self, message: Message) -> None:
        call = self._decode(message)
        if call is not None:
            self._answer(message.key.split("/", 2)[1], call, Status.BUSY)

    def _decode(self, message: Message) -> Call | None:
        try:
            return decode_call(message.payload or b"")
        except Malformed as bad:
            self.malformed += 1
            if self.malformed == 1:
                _logger.warning("dropped a call on %s: %s (further ones are counted, not logged)", message.key, bad)
            return None

    def _answer(self, caller: str, call: Call, status: int, body: Raw = EMPTY) -> None:
        replier = self._replier(caller, call.reply)
        if replier is not None and not self._closed:
            replier.put(encode_message(Reply(PROTOCOL, call.id, status, time.monotonic_ns(), body)))

    def _replier(self, caller: str, reply: str) -> Publisher | None:
        key = f"{caller}/{reply}"
        found = self._repliers.get(key)
        return found if found is not None else self._new_replier(key, caller, reply)

    def _new_replier(self, key: str, caller: str, reply: str) -> Publisher | None:
        container, _, channel = reply.partition("/")
        if not (is_chunk(container) and is_chunk(channel)):  # a wildcard would answer everybody
            self.malformed += 1
            return None
        with self._lock:
            if len(self._repliers) >= _MOST_REPLY_KEYS:
                self._repliers.pop(next(iter(self._repliers))).close()
            full = reply_key(self._own.identity, caller, container, channel)
            return self._repliers.setdefault(key, self._transport.publish(full))

    def close(self) -> None:
        """Take no more calls; those running may finish within two seconds. Idempotent."""
        self._closed = True
        for crew in self._crews:
            crew.close()
        for replier in self._repliers.values():
            replier.close()


class _Crew:
    """Threads on one channel; at least one of them always waits for the next message."""

    def __init__(
        self, name: str, channel: Channel, work: Callable[[Message], None], refuse: Callable[[Message], None]
    ) -> None:
        self._name = name
        self._channel = channel
        self._work = work
        self._refuse = refuse
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        with self._lock:
            self._hire()

    @property
    def draining(self) -> bool:
        return self._idle > 0

    def _hire(self) -> None:
        thread = threading.Thread(target=self._main, name=f"{self._name}-{len(self._threads)}", daemon=True)
        self._threads.append(thread)
        self._idle += 1
        thread.start()

    def _main(self) -> None:
        while True:
            try:
                message = self._channel.receive()
            except ChannelClosed:
                return
            left = self._leave_idle()
            try:
                (self._work if left else self._refuse)(message)
            except Exception:
                _logger.exception("a call on %s could not be answered", message.key)
            finally:
                if left:
                    with self._lock:
                        self._idle += 1

    def _leave_idle(self) -> bool:
        """Whether this thread may run the call: somebody else must be left to take the next one."""
        with self._lock:
            if self._idle > 1 or len(self._threads) < MOST_THREADS:
                if self._idle == 1:
                    self._hire()
                self._idle -= 1
                return True
            return False

    def close(self) -> None:
        self._channel.close()
        deadline = time.monotonic() + 2
        for thread in list(self._threads):
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
