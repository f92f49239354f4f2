"""The callee's side of a call: threads that read calls, check, run the provider, answer.

Leader and followers: the threads that run providers are the ones that wait for calls, so a call changes hands nowhere.
The last idle one that takes a call starts another; at the cap it answers Busy, so that the channel is always drained.
"""

import logging
import threading
import time
from collections.abc import Iterable
from functools import partial
from typing import Any, Final

import msgspec
from msgspec import Raw, Struct

from trade._audit.events import Audit
from trade._context.active_calls import (
    ActiveCall,
    Answer,
    CallDeduplicator,
    ProgressReporter,
    cancelled,
    end_calls,
    failed,
)
from trade._context.call_context import CallContext, outer_of
from trade._context.sessions import foreign
from trade._protocol.keys import DOMAIN, PROVIDER, Address, calls_to, is_chunk, reply_key
from trade._protocol.messages import (
    CANCEL,
    EMPTY,
    PROTOCOL,
    UNREADABLE,
    Call,
    CancelArguments,
    Malformed,
    Reply,
    Status,
    decode_call,
    encode_message,
)
from trade._security.authorizer import Authorizer
from trade._services.event_loop import AsyncLoop
from trade._services.local_service import LocalService
from trade._services.providers import Providers
from trade._services.serial_queue import SerialQueue
from trade._threads.channel_workers import WorkerPool
from trade._transport.base import ChannelClosed, Message, Publisher, Transport
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

_logger = logging.getLogger("trade")

_PARTING_S: Final = 2.0
ANYBODY: Final = "*"
_KINDS: Final = frozenset(("call", "stop"))
_MOST_REPLY_KEYS: Final = 1024
_MOST_WAITING: Final = 4096
"""Calls of one caller that is told from others."""
_MOST_CALLERS: Final = 1024
"""Of one service, whose admission is kept."""
_SYSTEM: Final = f"{DOMAIN}/{PROVIDER}"
_DEFECTS: Final = (InvalidResult, NotSerialisable, RemoteError)
"""Errors of ours that are mistakes of a provider; the others are answers it gives on purpose."""
_decode_cancel: Final = msgspec.msgpack.Decoder(CancelArguments).decode


class IncomingCall(Struct, frozen=True, gc=False):
    """A call that came in, and what its key says."""

    call: Call
    caller: str
    """Identity of who asks."""
    replier: Publisher
    """Where to answer."""
    place: str = ""
    """The ``domain/provider`` it is for; empty once only an answer is left to send."""


class Dispatcher:
    """Every incoming call of one container."""

    def __init__(
        self,
        transport: Transport,
        own: Address,
        providers: Providers,
        loop: AsyncLoop,
        access: Authorizer,
        audit: Audit,
    ) -> None:
        self._transport = transport
        self._audit = audit
        self._access = access
        self._loop = loop
        self._own = own
        self._here = f"{own}/"
        self._providers = providers
        self._repliers: dict[str, Publisher] = {}
        self._lock = threading.Lock()
        self._leaving = False
        self._closed = False
        self._deduplicator = CallDeduplicator()
        self._progress_reporter = ProgressReporter(self._send_progress)
        self.malformed = 0
        self.callers = set[str]()
        """Who is heard by channels of its own; nobody: all are heard by the same."""
        self._worker_pools: list[WorkerPool] = []
        if callers := access.callers():
            self.hear(callers)
        else:
            self._add_worker_pools(ANYBODY)

    def hear(self, callers: Iterable[str]) -> None:
        """Take calls of these from now on, too: each by channels of its own, so that who floods fills only those."""
        with self._lock:
            new = [caller for caller in dict.fromkeys(callers) if caller not in self.callers]
            self.callers.update(new)
            for caller in () if self._closed else new:
                self._add_worker_pools(caller)

    def _add_worker_pools(self, caller: str) -> None:
        """Threads for the calls of one caller and for its stops.

        Who can be told from others loses what it sends faster than it is taken: made to wait, it would hold up all who
        come by the same link.
        """
        for name, stop, refuse in (("trade-call", False, self._busy), ("trade-stop", True, self._serve)):
            pattern = calls_to(self._own, stop=stop, caller=caller)
            channel = self._transport.subscribe(pattern, newest=0 if caller == ANYBODY else _MOST_WAITING)
            self._worker_pools.append(WorkerPool(name, channel, self._serve, refuse))

    @property
    def draining(self) -> bool:
        """Whether some thread stands ready to take the next call."""
        return all(pool.draining for pool in self._worker_pools)

    def _serve(self, message: Message) -> None:
        incoming = self._take(message)
        if incoming is None:
            return
        try:
            service = self._providers.lookup(incoming.place, incoming.call.service)
        except ServiceGone as gone:  # it has moved
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
        else:
            self._begin(incoming, service)

    def _begin(self, incoming: IncomingCall, service: LocalService) -> None:
        ongoing = ActiveCall(incoming.caller, incoming.call, partial(self._report, service))
        first = self._deduplicator.begin(incoming.call, ongoing)
        if first is not ongoing or ongoing.answer is not None:
            self._again(first, incoming)
        elif service.serial is None:
            self._perform(ongoing, service, incoming)
        else:
            self._queue(service.serial, ongoing, service, incoming)

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
        if ongoing.said is not None:
            self._progress_reporter.send(ongoing)
        also = self._deduplicator.end(ongoing, incoming.call, answer, keep=service.effect != "read")
        self._answer(incoming, *answer)
        for again in also or ():
            self._answer(self._to_answer(incoming.caller, again), *answer)

    def _queue(self, serial: SerialQueue, ongoing: ActiveCall, service: LocalService, incoming: IncomingCall) -> None:
        def begin() -> None:
            if not self._leaving:
                with serial.held():
                    self._perform(ongoing, service, incoming)

        def drop() -> None:
            if serial.withdraw(begin):
                self._end(ongoing, service, incoming, cancelled(service.label))

        ongoing.on_cancel(drop)
        ongoing.queued_ns = time.monotonic_ns()
        if not serial.submit(begin):
            self._note(service.label, self._too_much(service.label), incoming)
            self._end(ongoing, service, incoming, (Status.BUSY, EMPTY))

    # --- calls that came before, and calls about calls

    def _again(self, first: ActiveCall, incoming: IncomingCall) -> None:
        """It runs or has run: it gets that answer, and never runs again."""
        answer = self._deduplicator.attach(first, incoming.call)
        if answer is not None:
            self._answer(incoming, *answer)

    def _refuse(self, incoming: IncomingCall, status: int, body: Raw = EMPTY) -> None:
        """It does not run now; but it may have before."""
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
        if call is None:  # it has ended
            return
        try:
            self._answer(self._to_answer(ongoing.caller, call), Status.PROGRESS, body)
        except ChannelClosed:
            _logger.debug("no word of the progress of %s: the container is closing", call.service)

    def _busy(self, message: Message) -> None:
        incoming = self._take(message)
        if incoming is not None:
            label = f"{incoming.place.partition('/')[0]}.{incoming.call.service}"
            self._note(label, self._too_much(label), incoming)
            self._refuse(incoming, Status.BUSY)

    def _too_much(self, label: str) -> Busy:
        return Busy(service=label, container=self._own.container)

    def _note(self, label: str, error: TradeError, incoming: IncomingCall) -> None:
        """Have it in the record that a call was refused."""
        call = incoming.call
        who, outer_id = foreign(call.session) or incoming.caller, outer_of(call.id, call.behalf)
        self._audit.refused(label, error, who=who, session=call.session, call_id=call.id, outer_id=outer_id)

    def _take(self, message: Message) -> IncomingCall | None:
        """The call of a message; None: it is no call, and dropped."""
        try:
            call = decode_call(message.payload or b"")
            kind, caller, place = message.key.split("/", 2)
            if kind not in _KINDS or not place.startswith(self._here):
                raise Malformed("a call goes to one provider, not to a pattern")
            if not call.session.startswith(f"{caller}/"):
                raise Malformed(f"session {call.session!r} is not one of {caller}")
            replier = self._replier(caller, call.reply)
        except (Malformed, ValueError) as bad:
            self.malformed += 1
            self._audit.refused(message.key, str(bad), who=message.key.split("/", 2)[1])
            if self.malformed == 1:
                _logger.warning("dropped a call on %s: %s (further ones are counted, not logged)", message.key, bad)
            return None
        return IncomingCall(call, caller, replier, place[len(self._here) :])

    def _answer(self, incoming: IncomingCall, status: int, body: Raw) -> None:
        if self._closed:
            return
        data = encode_message(Reply(PROTOCOL, incoming.call.id, status, time.monotonic_ns(), body))
        try:
            incoming.replier.put(data)
        except ChannelClosed:  # it was let go in between
            if not self._closed:
                self._replier(incoming.caller, incoming.call.reply).put(data)

    def _to_answer(self, caller: str, call: Call) -> IncomingCall:
        return IncomingCall(call, caller, self._replier(caller, call.reply))

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

    def forget(self, caller: Address) -> None:
        """A container is gone: nobody waits there for answers. For another one of its name keys are made anew."""
        begin = f"{caller.who}/"
        with self._lock:
            gone = [self._repliers.pop(key) for key in list(self._repliers) if key.startswith(begin)]
        for replier in gone:
            replier.close()

    def session_ended(self, session: str) -> None:
        """Nobody of it is there any more: what runs for it is asked to end, and with it what that has called."""
        end_calls([one.cancel for one in self._deduplicator.made_for(session)])

    def leave(self) -> None:
        """Start no call that waits for its turn: its caller is about to hear that this container has left."""
        self._leaving = True

    def close(self) -> None:
        """Take no more calls; those running may finish within two seconds. Idempotent."""
        self.leave()
        with self._lock:
            self._closed = True
        for pool in self._worker_pools:
            pool.close()
        for pool in self._worker_pools:
            pool.wait(_PARTING_S)
        self._loop.close()  # whoever still waits for a coroutine ends with it
        for pool in self._worker_pools:
            pool.wait(_PARTING_S)
        self._progress_reporter.close()
        for replier in list(self._repliers.values()):
            replier.close()


def _run(incoming: IncomingCall, service: LocalService, ongoing: ActiveCall | None) -> Answer:
    call, caller = incoming.call, incoming.caller
    expires = None if service.effect == "stop" else call.expires_ns
    context = CallContext(call.id, service.label, caller, call.session, expires, call.chain, ongoing, call.behalf)
    try:
        return Status.OK, Raw(service.signature.encode_result(service.label, service.run(call.args, context)))
    except BaseException as error:  # noqa: BLE001 - whatever a provider raises belongs to the caller
        info = service.failure(error, call.args)
        if not isinstance(error, TradeError) or isinstance(error, _DEFECTS):
            who = foreign(call.session) or caller
            text = info.traceback or info.message
            told = {"call_id": call.id, "outer_id": outer_of(call.id, call.behalf)}
            _logger.warning("%s failed in a call of %s:\n%s", service.label, who, text, extra=told)
        return Status.ERROR, Raw(encode_message(info))
