"""The callee's side of a call: threads that read calls, check, run the provider, answer.

Leader and followers: the threads that run providers are the ones that wait for calls, so a call changes hands nowhere.
The last idle one that takes a call starts another; at the cap it answers Busy, so that the channel is always drained.
"""

import asyncio
import concurrent.futures
import inspect
import logging
import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any, Final

from msgspec import Raw

from trade._context import CallContext, running
from trade._failures import pack_error, unpack_error
from trade._signature import Signature
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
from trade.errors import Cancelled, OutcomeUnknown

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 64
_KINDS: Final = frozenset(("call", "stop"))
_MOST_REPLY_KEYS: Final = 1024


class LocalService:
    """A method of a registered provider, ready to be called."""

    __slots__ = ("_loop", "effect", "label", "method", "signature")

    def __init__(
        self, label: str, signature: Signature, method: Callable[..., Any], effect: str, loop: "AsyncLoop"
    ) -> None:
        self.label = label
        self.signature = signature
        self.method = method
        self.effect = effect
        self._loop = loop

    def run(self, raw: Raw, context: CallContext) -> Any:
        """Validate, then call. Raises what the provider raises."""
        args, kwargs = self.signature.decode(raw)
        token = running.set(context)
        try:
            result = self.method(*args, **kwargs)
            return self._loop.complete(result, context) if inspect.iscoroutine(result) else result
        except (SystemExit, GeneratorExit, asyncio.CancelledError) as error:  # the provider's, not this thread's
            raise unpack_error(pack_error(error), self.label) from error
        finally:
            running.reset(token)

    def too_late(self, expires_ns: int | None) -> bool:
        """Whether running it now would be running it late; a stop is never late, a command of unknown expiry always."""
        if self.effect == "stop":
            return False
        if expires_ns is None:
            return self.effect != "read"
        return time.monotonic_ns() >= expires_ns


class AsyncLoop:
    """The event loop on which a container's ``async def`` services run, started by the first of them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    def complete(self, coroutine: Coroutine[Any, Any, Any], context: CallContext) -> Any:
        """Run an ``async def`` service from a handler thread; its deadline cancels it."""
        allowed_s = context.remaining_s
        future = asyncio.run_coroutine_threadsafe(_contained(coroutine, context.service), self._get())
        done, _ = concurrent.futures.wait([future], allowed_s)
        if allowed_s is not None and not done:
            future.cancel()
            raise OutcomeUnknown(service=context.service, deadline_s=allowed_s)
        try:
            return future.result()
        except concurrent.futures.CancelledError:
            raise Cancelled(service=context.service) from None

    def _get(self) -> asyncio.AbstractEventLoop:
        with self._lock:
            if self._loop is None:
                self._loop = asyncio.new_event_loop()
                self._thread = threading.Thread(target=_run_loop, args=(self._loop,), name="trade-async", daemon=True)
                self._thread.start()
            return self._loop

    def close(self) -> None:
        """Cancel what still runs and end the thread. Idempotent."""
        with self._lock:
            loop, thread = self._loop, self._thread
            self._loop = self._thread = None
        if loop is not None and thread is not None:
            loop.call_soon_threadsafe(loop.stop)
            if thread is not threading.current_thread():
                thread.join(2)


async def _contained(coroutine: Coroutine[Any, Any, Any], service: str) -> Any:
    """What would end the loop for everybody becomes an error for the caller."""
    try:
        return await coroutine
    except (SystemExit, KeyboardInterrupt) as error:
        raise unpack_error(pack_error(error), service) from error


def _run_loop(loop: asyncio.AbstractEventLoop) -> None:
    try:
        loop.run_forever()
        loop.run_until_complete(_cancel_all())
        loop.run_until_complete(loop.shutdown_asyncgens())
    finally:
        loop.close()


async def _cancel_all() -> None:
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


Lookup = Callable[[str, str], LocalService | None]
"""From ``domain/provider`` and the service's name to the service."""


class Dispatcher:
    """Every incoming call of one container."""

    def __init__(self, transport: Transport, own: Address, lookup: Lookup) -> None:
        self._transport = transport
        self._own = own
        self._here = f"{own}/"
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
        taken = self._take(message)
        if taken is None:
            return
        call, caller, provider, replier = taken
        service = self._lookup(provider, call.service)
        if service is None or (service.effect == "stop") is not message.key.startswith("stop/"):
            status, body = Status.GONE, EMPTY
        elif service.too_late(call.expires_ns):
            status, body = Status.EXPIRED, EMPTY
        else:
            status, body = _run(caller, call, service)
        self._answer(replier, caller, call, status, body)

    def _busy(self, message: Message) -> None:
        taken = self._take(message)
        if taken is not None:
            call, caller, _, replier = taken
            self._answer(replier, caller, call, Status.BUSY, EMPTY)

    def _take(self, message: Message) -> tuple[Call, str, str, Publisher] | None:
        """The call, who makes it, the ``domain/provider`` it is for, where to answer: else it is not run."""
        try:
            call = decode_call(message.payload or b"")
            kind, caller, place = message.key.split("/", 2)
            if kind not in _KINDS or not place.startswith(self._here):
                raise Malformed("a call goes to one provider, not to a pattern")
            replier = self._replier(caller, call.reply)
        except (Malformed, ValueError) as bad:
            self.malformed += 1
            if self.malformed == 1:
                _logger.warning("dropped a call on %s: %s (further ones are counted, not logged)", message.key, bad)
            return None
        return call, caller, place[len(self._here) :], replier

    def _answer(self, replier: Publisher, caller: str, call: Call, status: int, body: Raw) -> None:
        if self._closed:
            return
        data = encode_message(Reply(PROTOCOL, call.id, status, time.monotonic_ns(), body))
        try:
            replier.put(data)
        except ChannelClosed:  # it was let go in between
            if not self._closed:
                self._replier(caller, call.reply).put(data)

    def _replier(self, caller: str, reply: str) -> Publisher:
        key = f"{caller}/{reply}"
        found = self._repliers.get(key)
        return found if found is not None else self._new_replier(key, caller, reply)

    def _new_replier(self, key: str, caller: str, reply: str) -> Publisher:
        container, _, channel = reply.partition("/")
        if not (is_chunk(caller) and is_chunk(container) and is_chunk(channel)):  # a wildcard would answer everybody
            raise Malformed(f"{key!r} is nobody's reply key")
        with self._lock:
            if key not in self._repliers:
                if len(self._repliers) >= _MOST_REPLY_KEYS:
                    self._repliers.pop(next(iter(self._repliers))).close()
                self._repliers[key] = self._transport.publish(reply_key(self._own.identity, caller, container, channel))
            return self._repliers[key]

    def close(self) -> None:
        """Take no more calls; those running may finish within two seconds. Idempotent."""
        self._closed = True
        for crew in self._crews:
            crew.close()
        for replier in list(self._repliers.values()):
            replier.close()


def _run(caller: str, call: Call, service: LocalService) -> tuple[int, Raw]:
    expires = None if service.effect == "stop" else call.expires_ns
    context = CallContext(call.id, service.label, caller, call.session, expires, call.chain)
    try:
        return Status.OK, service.signature.encode_result(service.run(call.args, context))
    except BaseException as error:  # noqa: BLE001 - whatever a provider raises belongs to the caller
        return Status.ERROR, Raw(encode_message(pack_error(error)))


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
        thread.start()
        self._threads.append(thread)
        self._idle += 1

    def _main(self) -> None:
        while True:
            try:
                message = self._channel.receive()
            except ChannelClosed:
                return
            left = self._leave_idle()
            try:
                (self._work if left else self._refuse)(message)
            except ChannelClosed:
                _logger.debug("no answer on %s: the container is closing", message.key)
            except Exception:
                _logger.exception("a call on %s could not be answered", message.key)
            finally:
                if left:
                    with self._lock:
                        self._idle += 1

    def _leave_idle(self) -> bool:
        """Whether this thread may run the call: somebody else must be left to take the next one."""
        with self._lock:
            try:
                if self._idle == 1 and len(self._threads) < MOST_THREADS:
                    self._hire()
            except RuntimeError:  # the process may have no more threads
                _logger.exception("%s cannot have another thread", self._name)
            if self._idle == 1:
                return False
            self._idle -= 1
            return True

    def close(self) -> None:
        self._channel.close()
        deadline = time.monotonic() + 2
        for thread in list(self._threads):
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
