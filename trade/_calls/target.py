"""Call targets: how a handle becomes a result, with the same checks for local and remote services."""

import logging
from collections.abc import Callable
from functools import partial
from time import monotonic_ns
from typing import Any, Final

import msgspec
from msgspec import Raw

from trade._calls.arguments import ArgumentEncoder
from trade._calls.caller import Caller
from trade._calls.peer import Peer
from trade._calls.run import Run
from trade._context.active_calls import ActiveCall
from trade._context.call_context import CallContext, patience_s, running
from trade._context.outgoing import DEFAULT_DEADLINE_S, Request, handed_down, holding, in_ns, new_request
from trade._context.sessions import speaking
from trade._registry.registry import Record
from trade._services.local_service import LocalService
from trade._services.serial_queue import SerialQueue, Turn
from trade._telemetry.spans import traceable
from trade._threads.thread_pool import ThreadPool
from trade.errors import (
    Busy,
    Cancelled,
    ConfigurationError,
    ContainerLost,
    DeadlineExceeded,
    InvalidResult,
    LockLost,
    OutcomeUnknown,
    RemoteError,
    ServiceGone,
    as_never_ran,
)
from trade.protocol.codec import Codec
from trade.protocol.keys import CLOCK, DOMAIN, PROVIDER, Address
from trade.protocol.messages import (
    EMPTY_ARGUMENTS,
    PROTOCOL,
    UNREADABLE,
    Call,
    ErrorInfo,
    Reply,
    ServiceInfo,
    Status,
)
from trade.protocol.remote_errors import unpack_error
from trade.protocol.schema import read_schema
from trade.protocol.schema_types import type_from_schema

_logger = logging.getLogger("trade")

_decode_error: Final = msgspec.msgpack.Decoder(ErrorInfo).decode


_Taken = bytes | tuple[tuple[Any, ...], dict[str, Any]]
"""The encoded arguments of a strict call, or the plain ones of any other call."""


class LocalTarget:
    """A service of this container, called directly, with the validation and the copies that a wire would make."""

    def __init__(
        self, service: LocalService, record: Record, codec: Codec, caller: Caller, threads: ThreadPool
    ) -> None:
        self._service = service
        self._record = record
        self._thread_pool = threads
        self._thread_name = f"trade-run-{service.label}"
        self._arguments = ArgumentEncoder(codec, service.info, service.label)
        self._label = service.label
        self.is_stop = service.effect == "stop"
        self._own = caller.own
        self._identity = caller.own.identity
        self._session = caller.session
        self._new_id = caller.new_id

    def call(self, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Any:
        """Makes a new call; most inherit nothing and wait for nothing, and so need no request."""
        inherits = running.get() is not None or speaking.get() is not None or holding.get() or handed_down
        if inherits or self._service.serial is not None:
            return self.invoke(args, kwargs, new_request(deadline_s))
        expires_ns = None if self.is_stop else monotonic_ns() + in_ns(deadline_s)
        context = CallContext(self._new_id(), self._label, self._identity, self._session, expires_ns)
        if not self._service.strict:
            return self._service.call(args, kwargs, context)
        taken = self._arguments.encode(args, kwargs)
        self._check_time(expires_ns, deadline_s or DEFAULT_DEADLINE_S)
        return self._copied(taken, context)

    def invoke(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Any:
        """Makes the call of a request."""
        taken = self._arguments.encode(args, kwargs) if self._service.strict else (args, kwargs)
        if self._service.serial is None:
            return self._run(taken, request, None)
        return self._take_turn(self._service.serial, taken, request, None)

    def begin(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request, run: Run, *, here: bool) -> None:
        """Makes the call on another thread, or on this one (``here``), with the present values of the arguments."""
        service = self._service
        taken = self._arguments.encode(args, kwargs) if service.strict else (args, kwargs)

        def report(_: ActiveCall, value: Any) -> None:
            run.note_progress(service.signature.copy_progress(service.label, value) if service.strict else value)

        ongoing = ActiveCall(self._identity, None, report)
        run.on_cancel(ongoing.cancel)
        if service.serial is None:
            outcome = partial(self._run, taken, request, ongoing)
        else:
            outcome = partial(self._take_turn, service.serial, taken, request, ongoing)
        if here:
            run.end(outcome)
        else:
            self._thread_pool.begin(partial(run.end, outcome), self._thread_name)

    def _take_turn(self, serial: SerialQueue, taken: _Taken, request: Request, ongoing: ActiveCall | None) -> Any:
        if serial.mine:
            return self._run(taken, request, ongoing)
        turn = Turn()
        if ongoing is not None:
            ongoing.on_cancel(lambda: serial.drop(turn))
        if not serial.enter(turn, patience_s((request.deadline_ns - monotonic_ns()) / 1e9)):
            if ongoing is not None and ongoing.cancelled:
                raise Cancelled(service=self._service.label)
            raise DeadlineExceeded(service=self._service.label, deadline_s=request.deadline_s)
        try:
            with serial.held():
                return self._run(taken, request, ongoing)
        finally:
            serial.leave()

    def _run(self, taken: _Taken, request: Request, ongoing: ActiveCall | None) -> Any:
        service = self._service
        if ongoing is not None and ongoing.cancelled:
            raise Cancelled(service=service.label)
        context = self._context(request, ongoing)
        try:
            return service.call(*taken, context) if isinstance(taken, tuple) else self._copied(taken, context)
        except LockLost as lost:
            request.refused(self._own, lost)
            raise

    def _context(self, request: Request, ongoing: ActiveCall | None) -> CallContext:
        expires_ns = None if self.is_stop else request.deadline_ns
        self._check_time(expires_ns, request.deadline_s)
        behalf, session = None, self._session
        if request.inherited is not None:
            behalf, client = request.presence(self._record, self._own)
            session = client or session
        call_id, chain = self._new_id(), request.chain
        return CallContext(call_id, self._label, self._identity, session, expires_ns, chain, ongoing, behalf)

    def _check_time(self, expires_ns: int | None, deadline_s: float) -> None:
        if expires_ns is not None and monotonic_ns() >= expires_ns:
            raise DeadlineExceeded(service=self._label, deadline_s=deadline_s)

    def _copied(self, raw: bytes, context: CallContext) -> Any:
        service = self._service
        try:
            return service.signature.copy_result(service.label, service.run(raw, context))
        except Exception as error:  # whatever a provider raises
            if not service.signature.has_secrets:
                raise
            masked = unpack_error(service.failure(error, raw), service.label)
        raise masked  # as it would arrive over the wire, without secrets


class RemoteTarget:
    """A service of another container, with everything about its calls that can be prepared."""

    def __init__(self, record: Record, caller: Caller, codec: Codec, known: ServiceInfo | None = None) -> None:
        """``known`` describes the result, in place of the callee's own description."""
        address, key = record.key.address, record.key
        self._label = record.label
        self._record = record
        self._info: ServiceInfo = record.info
        self._caller = caller
        self._peer: Peer = caller.peer(address)
        self.is_stop = record.info.effect == "stop"
        self._arguments = ArgumentEncoder(codec, record.info, record.label)
        self._route = caller.route(self._peer, key.domain, key.provider, stop=self.is_stop, arguments=self._arguments)
        self._clock = caller.route(self._peer, DOMAIN, PROVIDER, stop=False)
        self._decode = result_decoder(codec, known or record.info)
        self._decode_any = codec.decoder(Any)
        self._traceable = traceable(key)

    def call(self, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Any:
        """Makes a new call."""
        return self.invoke(args, kwargs, new_request(deadline_s))

    def invoke(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Any:
        """Makes the call of a request."""
        values = self._values(args, kwargs, request)
        deadline_ns = request.deadline_ns + self._caller.clock.ahead_ns
        if not self._may_go:
            self._caller.expect_clock(self._peer)
            reply = self._caller.ask(self._clock_call(request), self._clock, deadline_ns)
            if reply.status != Status.OK:
                raise self._not_begun(reply, request)
        call = self._call(values, request)
        return self._unpack(self._caller.ask(call, self._route, deadline_ns), request)

    def begin(
        self,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        request: Request,
        run: Run,
        *,
        here: bool,  # noqa: ARG002 - it runs elsewhere
    ) -> None:
        """Makes the call without waiting; the run gets its outcome."""
        values = self._values(args, kwargs, request)
        deadline_ns = request.deadline_ns + self._caller.clock.ahead_ns

        def go() -> None:
            if run.cancelling:
                run.fail(Cancelled(service=self._label))
                return
            call = self._call(values, request)
            self._caller.start(call, self._route, deadline_ns, finish, note)
            run.on_cancel(partial(self._caller.cancel, self._peer, call.id, self._label, deadline_ns))

        def note(reply: Reply) -> None:
            try:
                run.note_progress(self._decode_any(reply.body))
            except Exception as bad:  # noqa: BLE001 - the bytes are anything
                _logger.debug("the progress of %s cannot be decoded: %s", self._label, bad)

        def finish(reply: Reply) -> None:
            run.end(lambda: self._unpack(reply, request))

        def clock_heard(reply: Reply) -> None:
            go() if reply.status == Status.OK else run.fail(self._not_begun(reply, request))

        if self._may_go:
            go()
        else:
            self._caller.expect_clock(self._peer)
            self._caller.start(self._clock_call(request), self._clock, deadline_ns, clock_heard)

    @property
    def _may_go(self) -> bool:
        """Whether the call can be sent without requesting the callee's clock first."""
        return self.is_stop or self._peer.clock_known

    def _values(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Any:
        """The arguments: as values for a message made now, as checked bytes for a later one."""
        if self.is_stop:
            request.ignore_outer_deadline()
        elif request.deadline_s <= 0:
            raise DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
        if self._may_go:
            return self._arguments.values(args, kwargs)
        return Raw(self._arguments.encode(args, kwargs))

    def _call(self, values: Any, request: Request) -> Call:
        """The message, with its deadline in the callee's clock."""
        expires_ns = None if self.is_stop else self._peer.expiry_ns(request.deadline_ns)
        return self._message(self._info.name, values, expires_ns, request)

    def _clock_call(self, request: Request) -> Call:
        return self._message(CLOCK, EMPTY_ARGUMENTS, None, request)

    def _message(self, service: str, values: Any, expires_ns: int | None, request: Request) -> Call:
        caller, chain = self._caller, request.chain
        behalf, client = request.presence(self._record, caller.own)
        session = client or caller.session
        return Call(PROTOCOL, caller.new_id(), service, "", session, expires_ns, chain, values, behalf)

    def _unpack(self, reply: Reply, request: Request) -> Any:
        error = None if reply.status == Status.OK else self._failure(reply, request)
        spans = self._caller.spans
        if spans is not None and self._traceable:
            spans.record_outgoing(reply.id, self._label, request, error)
        if error is not None:
            request.refused(self._peer.address, error)
            raise error
        try:
            return self._decode(reply.body)
        except UNREADABLE as bad:
            raise InvalidResult(service=self._label, problem=str(bad)) from None

    def _not_begun(self, reply: Reply, request: Request) -> BaseException:
        """The error when the callee's clock was not received, so that the call was never sent."""
        if reply.status == Status.TIMED_OUT:
            return DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
        if reply.status == Status.LOST:
            return self._gone()
        return self._failure(reply, request)

    def _gone(self) -> BaseException:
        if self._caller.closed:
            return container_closed(self._caller.own)
        reason = f"container {self._peer.address.container} has ended, restarted or cannot be reached"
        return as_never_ran(ServiceGone(service=self._label, reason=reason), self._record.key)

    def _failure(self, reply: Reply, request: Request) -> BaseException:
        container = self._peer.address.container
        match reply.status:
            case Status.ERROR:
                error = self._error(reply)
                if self._caller.leaving and isinstance(error, Cancelled):  # as its session has ended
                    return ContainerLost(service=self._label, container=self._caller.own.container)
                return error
            case Status.BUSY:
                return as_never_ran(Busy(service=self._label, container=container), self._record.key)
            case Status.EXPIRED:
                return DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
            case Status.GONE:
                return as_never_ran(ServiceGone(service=self._label), self._record.key)
            case Status.TIMED_OUT:
                return OutcomeUnknown(service=self._label, deadline_s=request.deadline_s)
            case Status.UNSENT:
                return self._gone()
            case Status.LOST:
                return ContainerLost(service=self._label, container=container)
            case _:
                return ContainerLost(service=self._label, container=self._caller.own.container)

    def _error(self, reply: Reply) -> BaseException:
        try:
            return unpack_error(_decode_error(reply.body), self._label)
        except UNREADABLE as bad:
            return RemoteError(service=self._label, type_name="an error that cannot be read", message=str(bad))


def result_decoder(codec: Codec, info: ServiceInfo) -> Callable[[Any], Any]:
    """A decoder for the result, with the types that its description allows."""
    try:
        return codec.decoder(type_from_schema(read_schema(info.result_schema), info.types))
    except Exception as bad:  # noqa: BLE001 - a foreign schema may be anything
        _logger.debug("the result of %s stays plain data: %s", info.name, bad)
        return codec.decoder(Any)


def container_closed(own: Address) -> ConfigurationError:
    """The error of every use of a closed container."""
    return ConfigurationError(where=own.container, problem="this container is closed; start another one")
