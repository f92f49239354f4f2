"""The callee's side of a call: threads that read calls, check them, run the provider, and answer.

Leader/followers: the threads that run providers also wait for calls, so no call changes threads. The last idle thread
that takes a call starts another; at the limit it answers Busy, so that the channel is always drained.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final, Protocol

import msgspec
from msgspec import Raw, Struct

from trade._audit.events import Audit
from trade._context.active_calls import (
    ActiveCall,
    Answer,
    CallDeduplicator,
    KeptAnswer,
    ProgressReporter,
    cancelled,
    end_calls,
    failed,
)
from trade._context.call_context import CallContext, outer_of
from trade._context.sessions import foreign
from trade._security.authorizer import Authorizer
from trade._services.event_loop import AsyncLoop
from trade._services.local_service import LocalService
from trade._services.providers import Providers
from trade._services.serial_queue import SerialQueue
from trade._threads.channel_workers import WorkerPool
from trade._threads.scheduler import Scheduler
from trade.errors import (
    AccessDenied,
    Busy,
    DeadlineExceeded,
    InvalidResult,
    NotSerialisable,
    RemoteError,
    ServiceGone,
    TradeError,
)
from trade.protocol.keys import DOMAIN, LOCAL, PROVIDER, Address, calls_to, is_chunk, reply_key
from trade.protocol.messages import (
    CANCEL,
    EMPTY,
    LARGE,
    PROTOCOL,
    UNREADABLE,
    Call,
    CancelArguments,
    LargeBytes,
    Malformed,
    Reply,
    Status,
    decode_call,
    encode_message,
)
from trade.transport.base import ChannelClosed, Message, Publisher, Transport

_logger = logging.getLogger("trade")

_PARTING_S: Final = 2.0
ANYBODY: Final = "*"
_KINDS: Final = frozenset(("call", "stop"))
_MOST_REPLY_KEYS: Final = 1024
_MOST_WAITING: Final = 4096
"""Waiting calls of one identified caller."""
_MOST_CALLERS: Final = 1024
"""Cached authorisations of one service."""
_QUICK_NS: Final = 200_000
_SYSTEM: Final = f"{DOMAIN}/{PROVIDER}"
_DEFECTS: Final = (InvalidResult, NotSerialisable, RemoteError)
"""Our errors that are a provider's defect; a provider raises the others on purpose."""
_decode_cancel: Final = msgspec.msgpack.Decoder(CancelArguments).decode


HandOver = Callable[[Callable[[], None]], None]


class IncomingCall(Struct, frozen=True, gc=False):
    """A call that came in, and the contents of its key."""

    call: Call
    caller: str
    """Identity of the caller."""
    replier: Publisher
    """Where to answer."""
    place: str = ""
    """The ``domain/provider`` that it calls; empty once only the answer remains to be sent."""


class _NullPublisher(Publisher):
    """Takes the answers of connections that have ended."""

    def put(self, payload: bytes) -> None: ...
    def close(self) -> None: ...


_NOWHERE: Final = _NullPublisher()


class CallPool(Protocol):
    """Threads that take calls: of a channel, or of the local path."""

    taken: int
    """The number of calls that it has begun to process, without refused ones."""

    @property
    def draining(self) -> bool: ...
    @property
    def working(self) -> int: ...
    def close(self) -> None: ...
    def wait(self, most_s: float) -> None: ...


class Dispatcher:
    """Handles every incoming call of one container."""

    def __init__(
        self,
        transport: Transport,
        own: Address,
        providers: Providers,
        loop: AsyncLoop,
        access: Authorizer,
        audit: Audit,
        timers: Scheduler,
    ) -> None:
        self._transport = transport
        self._audit = audit
        self._access = access
        self._loop = loop
        self._own = own
        self._here = f"{own}/"
        self._providers = providers
        self._repliers: dict[str, Publisher] = {}
        self._local_repliers: dict[str, Publisher] = {}
        """Those on connections of the local path."""
        self._lock = threading.Lock()
        self._leaving = False
        self._closed = False
        self._deduplicator = CallDeduplicator()
        self._progress_reporter = ProgressReporter(self._send_progress, timers)
        self.malformed = 0
        self.callers = set[str]()
        """Identities with channels of their own; empty: all share the same channels."""
        self.pools: Final[list[CallPool]] = []
        """The threads that take calls."""
        if callers := access.callers():
            self.hear(callers)
        else:
            self._add_worker_pools(ANYBODY)

    def hear(self, callers: Iterable[str]) -> None:
        """Add callers, each with its own channels, so that a flood fills only the channels of its caller."""
        with self._lock:
            new = [caller for caller in dict.fromkeys(callers) if caller not in self.callers]
            self.callers.update(new)
            for caller in () if self._closed else new:
                self._add_worker_pools(caller)

    def _add_worker_pools(self, caller: str) -> None:
        """Starts threads for the calls of one caller, and for its stops.

        An identified caller loses the calls that it sends faster than they are taken: a caller made to wait would delay
        all others on the same link.
        """
        for name, stop, refuse in (("trade-call", False, self.busy), ("trade-stop", True, self.serve)):
            pattern = calls_to(self._own, stop=stop, caller=caller)
            channel = self._transport.subscribe(pattern, newest=0 if caller == ANYBODY else _MOST_WAITING)
            self.pools.append(WorkerPool(name, channel, self.serve, refuse))

    @property
    def draining(self) -> bool:
        """Whether a thread is ready to take the next call."""
        return all(pool.draining for pool in self.pools)

    def serve(
        self, message: Message, hand_over: HandOver | None = None, *, pass_on: Callable[[], None] | None = None
    ) -> None:
        """Runs the call of a message, and answers it.

        Args:
            message: the call.
            hand_over: runs on another thread what is left to do when it has its answer; none: this thread does.
            pass_on: lets another thread read the next message; none: one does already.
        """
        incoming = self._take(message)
        if incoming is None:
            return
        try:
            service = self._providers.lookup(incoming.place, incoming.call.service)
        except ServiceGone as gone:  # its provider has moved
            self._refuse(incoming, *failed(gone))
            return
        urgent = message.key.startswith("stop/")
        if service is None or (service.effect == "stop") is not urgent:
            if urgent and incoming.call.service == CANCEL and incoming.place == _SYSTEM:
                self._answer(incoming, *self._cancel(incoming))
            else:
                self._refuse(incoming, Status.GONE)
        elif (denied := self._denied(incoming, service)) is not None:
            self._note(service.label, denied, incoming)
            self._refuse(incoming, *failed(denied))
        elif urgent:
            self._answer(incoming, *_run(incoming, service, None))
        elif pass_on is None:
            self._begin(incoming, service, hand_over)
        else:
            if not service.quick:
                pass_on()
            began_ns = time.monotonic_ns()
            self._begin(incoming, service, hand_over)
            service.quick = time.monotonic_ns() - began_ns < _QUICK_NS

    def _begin(self, incoming: IncomingCall, service: LocalService, hand_over: HandOver | None) -> None:
        ongoing = ActiveCall(incoming.caller, incoming.call, partial(self._report, service))
        first = self._deduplicator.begin(incoming.call, ongoing)
        if first is not ongoing or ongoing.answer is not None:
            self._again(first, incoming)
        elif service.serial is None:
            self._perform(ongoing, service, incoming)
        else:
            self._queue(service.serial, ongoing, service, incoming, hand_over)

    def _denied(self, incoming: IncomingCall, service: LocalService) -> AccessDenied | None:
        """Why a caller may not call a service; decided once for each policy."""
        policy, caller = self._access.policy, incoming.caller
        if policy is None or service.admitted.get(caller) is policy:
            return None
        domain = incoming.place.partition("/")[0]
        denied = self._access.denied_call(policy, caller, domain, service.info.name, service.effect, service.label)
        if denied is None:
            if len(service.admitted) >= _MOST_CALLERS:
                service.admitted.clear()
            service.admitted[caller] = policy
        return denied

    def _perform(self, ongoing: ActiveCall, service: LocalService, incoming: IncomingCall) -> None:
        if service.too_late(incoming.call.expires_ns):
            answer: Answer = (Status.EXPIRED, EMPTY)
            self._note(service.label, DeadlineExceeded(service=service.label, deadline_s=0.0), incoming)
        elif ongoing.cancelled:
            answer = cancelled(service.label)
        else:
            answer = _run(incoming, service, ongoing)
        self._end(ongoing, service, incoming, answer)

    def _end(self, ongoing: ActiveCall, service: LocalService, incoming: IncomingCall, answer: Answer) -> None:
        if ongoing.unsent is not None:
            self._progress_reporter.send(ongoing)
        also = self._deduplicator.end(ongoing, incoming.call, answer, keep=service.effect != "read")
        self._answer(incoming, *answer)
        for again in also or ():
            self._answer(self._to_answer(incoming.caller, again), *answer)

    def _queue(
        self,
        serial: SerialQueue,
        ongoing: ActiveCall,
        service: LocalService,
        incoming: IncomingCall,
        hand_over: HandOver | None,
    ) -> None:
        def begin() -> None:
            if not self._leaving:
                with serial.held():
                    self._perform(ongoing, service, incoming)

        def drop() -> None:
            if serial.withdraw(begin):
                self._end(ongoing, service, incoming, cancelled(service.label))

        ongoing.on_cancel(drop)
        ongoing.queued_ns = time.monotonic_ns()
        if not serial.submit(begin, hand_over):
            self._note(service.label, self._too_much(service.label), incoming)
            self._end(ongoing, service, incoming, (Status.BUSY, EMPTY))

    # --- repeated calls, and calls about calls

    def _again(self, first: ActiveCall | KeptAnswer, incoming: IncomingCall) -> None:
        """A repeated call: it gets the answer of the first one, and never runs again."""
        answer = self._deduplicator.attach(first, incoming.call)
        if answer is not None:
            self._answer(incoming, *answer)

    def _refuse(self, incoming: IncomingCall, status: int, body: Raw | LargeBytes = EMPTY) -> None:
        """Answer without running the call; the call may have run before."""
        first = self._deduplicator.find(incoming.caller, incoming.call)
        if first is not None:
            self._again(first, incoming)
        else:
            self._answer(incoming, status, body)

    def _cancel(self, incoming: IncomingCall) -> Answer:
        try:
            asked = _decode_cancel(incoming.call.args)
        except UNREADABLE as bad:
            return failed(bad)
        self._deduplicator.cancel(incoming.caller, asked.id, asked.service, asked.keep_s)
        return Status.OK, EMPTY

    def _report(self, service: LocalService, ongoing: ActiveCall, value: Any) -> None:
        self._progress_reporter.report(ongoing, Raw(service.signature.encode_progress(service.label, value)))

    def _send_progress(self, ongoing: ActiveCall, body: Raw) -> None:
        call = ongoing.call
        if call is None:  # the call has ended
            return
        try:
            self._answer(self._to_answer(ongoing.caller, call), Status.PROGRESS, body)
        except ChannelClosed:
            _logger.debug("the progress of %s is not sent: the container is closing", call.service)

    def busy(self, message: Message) -> None:
        """Answers the call of a message that there are too many calls."""
        incoming = self._take(message)
        if incoming is not None:
            label = f"{incoming.place.partition('/')[0]}.{incoming.call.service}"
            self._note(label, self._too_much(label), incoming)
            self._refuse(incoming, Status.BUSY)

    def _too_much(self, label: str) -> Busy:
        return Busy(service=label, container=self._own.container)

    def _note(self, label: str, error: TradeError, incoming: IncomingCall) -> None:
        """Record that a call was refused."""
        call = incoming.call
        who, outer_id = incoming.caller, outer_of(call.id, call.behalf)
        self._audit.refused(label, error, who=who, session=call.session, call_id=call.id, outer_id=outer_id)

    def _take(self, message: Message) -> IncomingCall | None:
        """The call of a message; None: the message is not a call, and was dropped."""
        try:
            call = decode_call(message.payload or b"")
            kind, caller, place = message.key.split("/", 2)
            if kind not in _KINDS or not place.startswith(self._here):
                raise Malformed("a call goes to one provider, not to a pattern")
            if not call.session.startswith(f"{caller}/"):
                raise Malformed(f"session {call.session!r} is not one of {caller}")
            replier = self._replier(caller, call.reply)
        except (Malformed, ValueError) as bad:
            self.drop(message.key, message.key.split("/", 2)[1], bad)
            return None
        return IncomingCall(call, caller, replier, place[len(self._here) :])

    def drop(self, where: str, identity: str, bad: Exception) -> None:
        """Records that something came in that is no call."""
        self.malformed += 1
        self._audit.refused(where, str(bad), who=identity)
        if self.malformed == 1:
            _logger.warning("dropped a call on %s: %s (further ones are counted, not logged)", where, bad)

    def _answer(self, incoming: IncomingCall, status: int, body: Raw | LargeBytes) -> None:
        if self._closed:
            return
        try:
            _send(incoming.replier, incoming.call.id, status, body)
        except ChannelClosed:  # the publisher was closed meanwhile
            if not self._closed:
                _send(self._replier(incoming.caller, incoming.call.reply), incoming.call.id, status, body)

    def _to_answer(self, caller: str, call: Call) -> IncomingCall:
        return IncomingCall(call, caller, self._replier(caller, call.reply))

    def _replier(self, caller: str, reply: str) -> Publisher:
        key = f"{caller}/{reply}"
        found = self._local_repliers.get(key) or self._repliers.get(key)
        return found if found is not None else self._new_replier(key, caller, reply)

    def _new_replier(self, key: str, caller: str, reply: str) -> Publisher:
        container, _, channel = reply.partition("/")
        if not (is_chunk(caller) and is_chunk(container) and is_chunk(channel)):  # a wildcard would answer all callers
            raise Malformed(f"{key!r} is not a valid reply key")
        if LOCAL in channel:  # its connection has ended, and no channel of the transport has this key
            return _NOWHERE
        with self._lock:
            if key not in self._repliers:
                if len(self._repliers) >= _MOST_REPLY_KEYS:
                    self._repliers.pop(next(iter(self._repliers))).close()
                self._repliers[key] = self._transport.publish(reply_key(self._own.identity, caller, container, channel))
            return self._repliers[key]

    def answer_on(self, caller: str, reply: str, replier: Publisher) -> None:
        """Answers the calls of an identity with this reply key on a connection of their own, until `answer_no_more`."""
        self._local_repliers[f"{caller}/{reply}"] = replier

    def answer_no_more(self, caller: str, reply: str, replier: Publisher) -> None:
        """The connection has ended."""
        with self._lock:
            if self._local_repliers.get(f"{caller}/{reply}") is replier:
                del self._local_repliers[f"{caller}/{reply}"]

    def hang_up(self, caller: Address) -> None:
        """End the connections of a container: what it still reads there counts for nothing."""
        local = f"{caller.who}/{caller.epoch}{LOCAL}"
        with self._lock:
            gone = [one for key, one in self._local_repliers.copy().items() if key.startswith(local)]
        for replier in gone:
            replier.close()

    def forget(self, caller: Address) -> None:
        """A container is gone: release its reply keys. A new container of its name gets new ones."""
        begin = f"{caller.who}/"
        with self._lock:
            gone = [self._repliers.pop(key) for key in list(self._repliers) if key.startswith(begin)]
        for replier in gone:
            replier.close()

    def session_ended(self, session: str) -> None:
        """A session has ended: cancel the calls that run for it, and the calls that those have made."""
        end_calls([one.cancel for one in self._deduplicator.made_for(session)])

    def leave(self) -> None:
        """Start no queued call any more: its caller is about to hear that this container has shut down."""
        self._leaving = True

    def close(self) -> None:
        """Take no more calls; those running may finish within two seconds. Idempotent."""
        self.leave()
        with self._lock:
            self._closed = True
        for pool in list(self.pools):
            pool.close()
        for pool in list(self.pools):
            pool.wait(_PARTING_S)
        self._loop.close()  # threads that still wait for a coroutine end with it
        for pool in list(self.pools):
            pool.wait(_PARTING_S)
        self._progress_reporter.close()
        for replier in list(self._repliers.values()):
            replier.close()


def _send(replier: Publisher, call_id: int, status: int, body: Raw | LargeBytes) -> None:
    if isinstance(body, Raw) and len(body) < LARGE:
        replier.put(encode_message(Reply(PROTOCOL, call_id, status, time.monotonic_ns(), body)))
    else:  # the body is the last part of a message
        empty = encode_message(Reply(PROTOCOL, call_id, status, time.monotonic_ns(), EMPTY))
        head = empty[: -len(EMPTY)]
        if isinstance(body, Raw):
            replier.put_parts(head, body)
        else:
            replier.put_parts(head + body.head, body.value)


def _run(incoming: IncomingCall, service: LocalService, ongoing: ActiveCall | None) -> Answer:
    call, caller = incoming.call, incoming.caller
    expires = None if service.effect == "stop" else call.expires_ns
    context = CallContext(call.id, service.label, caller, call.session, expires, call.chain, ongoing, call.behalf)
    try:
        return Status.OK, service.signature.encode_body(service.label, service.run(call.args, context))
    except BaseException as error:  # noqa: BLE001 - every error of a provider goes to the caller
        info = service.failure(error, call.args)
        if not isinstance(error, TradeError) or isinstance(error, _DEFECTS):
            who = foreign(call.session) or caller
            text = info.traceback or info.message
            ids = {"call_id": call.id, "outer_id": outer_of(call.id, call.behalf)}
            _logger.warning("%s failed in a call of %s:\n%s", service.label, who, text, extra=ids)
        return Status.ERROR, Raw(encode_message(info))
