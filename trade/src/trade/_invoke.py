"""From a handle to a result: the same checks whether the service is here or elsewhere."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import msgspec
from msgspec import Raw

from trade._calls import Caller, Peer
from trade._context import CallContext, holding, running
from trade._dispatch import LocalService
from trade._failures import unpack_error
from trade._handle import Run
from trade._ongoing import Ongoing
from trade._records import type_from_schema
from trade._registry import Record
from trade._serial import Turn
from trade._signature import Codec, encode_arguments
from trade._system import CLOCK, DOMAIN, PROVIDER
from trade._wire import EMPTY_ARGUMENTS, Address, Behalf, ErrorInfo, Reply, ServiceInfo, Status, Token
from trade.errors import (
    Busy,
    Cancelled,
    ConfigurationError,
    ContainerLost,
    DeadlineExceeded,
    InvalidResult,
    OutcomeUnknown,
    RemoteError,
    ServiceGone,
)

_logger = logging.getLogger("trade")

DEFAULT_DEADLINE_S: Final = 10.0

_NOBODY: Final = Behalf()
_decode_error: Final = msgspec.msgpack.Decoder(ErrorInfo).decode


class Request:
    """One call on its way out: deadline and chain, inherited from the call that makes it."""

    __slots__ = ("_around", "_asked_s", "_begun_ns", "_outer", "chain", "deadline_ns", "deadline_s")

    def __init__(self, deadline_s: float | None) -> None:
        self._begun_ns = now = time.monotonic_ns()
        self._asked_s = self.deadline_s = DEFAULT_DEADLINE_S if deadline_s is None else deadline_s
        self.deadline_ns = now + int(self.deadline_s * 1e9)
        self.chain: tuple[str, ...] = ()
        self._around = holding.get()
        self._outer = outer = running.get()
        if outer is None:
            return
        self.chain = (*outer.chain, outer.service)
        if outer.expires_ns is not None and outer.expires_ns < self.deadline_ns:
            self.deadline_ns = outer.expires_ns
            self.deadline_s = max(0.0, (outer.expires_ns - now) / 1e9)

    def behalf(self, effect: str, own: Address) -> Behalf | None:
        """What the call inherits; the locks around it unless it stops, which needs none.

        Raises:
            LockLost: it actuates, and would do so under a lock that holds no more.
        """
        outer, around = self._outer, self._around
        if outer is None and not around:
            return None
        locks = [lock for lock in around if lock.owner == own]
        tokens: tuple[Token, ...] = ()
        if effect != "stop":
            tokens = tuple(token for lock in locks if effect == "actuate" or lock.held for token in lock.tokens())
        if outer is None:
            return Behalf((), (), tokens) if tokens else None
        inherited = outer.behalf or _NOBODY
        if effect != "stop":
            tokens += inherited.tokens
        return Behalf(outer.sessions, (outer.id, *inherited.calls), tokens)

    def ignore_outer_deadline(self) -> None:
        """A stop is sent and waited for however late the call is that makes it."""
        self.deadline_s = self._asked_s
        self.deadline_ns = self._begun_ns + int(self._asked_s * 1e9)


class LocalTarget:
    """A service of this container: called directly, with the validation and the copies a wire would make."""

    def __init__(
        self, service: LocalService, codec: Codec, own: Address, session: str, new_id: Callable[[], int]
    ) -> None:
        self._service = service
        self._codec = codec
        self._own = own
        self._session = session
        self._new_id = new_id

    def invoke(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Any:
        return self._take_turn(self._prepared(args, kwargs), request, None)

    def begin(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request, run: Run) -> None:
        """The same on a thread of its own, with the arguments as they are now."""
        service = self._service
        do = self._prepared(args, kwargs)

        def report(_: Ongoing, value: Any) -> None:
            run.note_progress(service.signature.copy_progress(value) if service.strict else value)

        ongoing = Ongoing(service, self._own.identity, None, report)
        run.on_cancel(ongoing.cancel)
        name = f"trade-run-{service.label}"
        outcome = partial(self._take_turn, do, request, ongoing)
        threading.Thread(target=run.end, args=(outcome,), name=name, daemon=True).start()

    def _prepared(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Callable[[CallContext], Any]:
        """What to do when its time has come, with the arguments as they are now."""
        service = self._service
        if not service.strict:
            return lambda context: service.run_straight(args, kwargs, context)
        raw = encode_arguments(self._codec, service.signature.info, service.label, args, kwargs)

        def copied(context: CallContext) -> Any:
            return service.signature.copy_result(service.run(raw, context))

        return copied if not service.signature.has_secrets else lambda context: self._discreet(copied, context, raw)

    def _discreet(self, do: Callable[[CallContext], Any], context: CallContext, raw: Raw) -> Any:
        """An error as it would come over the wire: without what is secret."""
        try:
            return do(context)
        except Exception as error:  # noqa: BLE001 - whatever a provider raises
            masked = unpack_error(self._service.failure(error, raw), self._service.label)
        raise masked

    def _take_turn(self, do: Callable[[CallContext], Any], request: Request, ongoing: Ongoing | None) -> Any:
        serial = self._service.serial
        if serial is None or serial.mine:
            return self._run(do, request, ongoing)
        turn = Turn()
        if ongoing is not None:
            ongoing.on_cancel(lambda: serial.drop(turn))
        if not serial.enter(turn, (request.deadline_ns - time.monotonic_ns()) / 1e9):
            if ongoing is not None and ongoing.cancelled:
                raise Cancelled(service=self._service.label)
            raise DeadlineExceeded(service=self._service.label, deadline_s=request.deadline_s)
        try:
            return self._run(do, request, ongoing)
        finally:
            serial.leave()

    def _run(self, do: Callable[[CallContext], Any], request: Request, ongoing: Ongoing | None) -> Any:
        service = self._service
        if ongoing is not None and ongoing.cancelled:
            raise Cancelled(service=service.label)
        expires_ns = None if service.effect == "stop" else request.deadline_ns
        if service.too_late(expires_ns):
            raise DeadlineExceeded(service=service.label, deadline_s=request.deadline_s)
        behalf = request.behalf(service.effect, self._own)
        identity, session = self._own.identity, self._session
        return do(
            CallContext(self._new_id(), service.label, identity, session, expires_ns, request.chain, ongoing, behalf)
        )


class RemoteTarget:
    """A service of another container, with everything about calling it that can be decided beforehand."""

    def __init__(self, record: Record, caller: Caller, codec: Codec) -> None:
        address, key = record.key.address, record.key
        self._label = record.label
        self._info: ServiceInfo = record.info
        self._codec = codec
        self._caller = caller
        self._peer: Peer = caller.peer(address)
        self._is_stop = record.info.effect == "stop"
        self._publisher = caller.publisher(address, key.domain, key.provider, stop=self._is_stop)
        self._clock = caller.publisher(address, DOMAIN, PROVIDER, stop=False)
        self._decode = _result_decoder(codec, record.info)
        self._decode_any = codec.decoder(Any)

    def invoke(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Any:
        raw = self._encode(args, kwargs, request)
        if not (self._peer.clock_known or self._is_stop):
            reply = self._ask(self._clock, CLOCK, EMPTY_ARGUMENTS, None, request)
            if reply.status != Status.OK:
                raise self._not_begun(reply, request)
        return self._unpack(self._ask(self._publisher, self._info.name, raw, self._expiry(request), request), request)

    def begin(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request, run: Run) -> None:
        """The same without waiting; the outcome goes into the run."""
        raw = self._encode(args, kwargs, request)

        def go() -> None:
            if run.cancelling:
                run.fail(Cancelled(service=self._label))
                return
            call_id = self._start(self._publisher, self._info.name, raw, self._expiry(request), request, finish, note)
            run.on_cancel(lambda: self._caller.cancel(self._peer, call_id, self._label, request.deadline_ns))

        def note(reply: Reply) -> None:
            try:
                run.note_progress(self._decode_any(reply.body))
            except Exception as bad:  # noqa: BLE001 - the bytes are anything
                _logger.debug("%s said something of its progress that cannot be read: %s", self._label, bad)

        def finish(reply: Reply) -> None:
            run.end(lambda: self._unpack(reply, request))

        def clock_heard(reply: Reply) -> None:
            go() if reply.status == Status.OK else run.fail(self._not_begun(reply, request))

        if self._peer.clock_known or self._is_stop:
            go()
        else:
            self._start(self._clock, CLOCK, EMPTY_ARGUMENTS, None, request, clock_heard)

    def _encode(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Raw:
        raw = encode_arguments(self._codec, self._info, self._label, args, kwargs)
        if self._is_stop:
            request.ignore_outer_deadline()
        elif request.deadline_s <= 0:
            raise DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
        return raw

    def _expiry(self, request: Request) -> int | None:
        return None if self._is_stop else self._peer.expiry_ns(request.deadline_ns)

    def _ask(self, publisher: Any, service: str, raw: Raw, expires_ns: int | None, request: Request) -> Reply:
        behalf = request.behalf(self._info.effect, self._caller.own)
        return self._caller.ask(
            self._peer, publisher, service, raw, request.deadline_ns, expires_ns, request.chain, behalf
        )

    def _start(
        self,
        publisher: Any,
        service: str,
        raw: Raw,
        expires_ns: int | None,
        request: Request,
        then: Callable[[Reply], None],
        on_progress: Callable[[Reply], None] | None = None,
    ) -> int:
        behalf, chain = request.behalf(self._info.effect, self._caller.own), request.chain
        return self._caller.start(
            self._peer, publisher, service, raw, request.deadline_ns, expires_ns, chain, then, on_progress, behalf
        )

    def _unpack(self, reply: Reply, request: Request) -> Any:
        if reply.status != Status.OK:
            raise self._failure(reply, request)
        try:
            return self._decode(reply.body)
        except msgspec.DecodeError as bad:
            raise InvalidResult(service=self._label, problem=str(bad)) from None

    def _not_begun(self, reply: Reply, request: Request) -> BaseException:
        """The answer to the question before the call was none: the call itself was never sent."""
        if reply.status == Status.TIMED_OUT:
            return DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
        if reply.status == Status.LOST:
            return self._gone()
        return self._failure(reply, request)

    def _gone(self) -> BaseException:
        if self._caller.closed:
            return container_closed(self._caller.own)
        reason = f"container {self._peer.address.container} has ended, restarted or cannot be reached"
        return ServiceGone(service=self._label, reason=reason)

    def _failure(self, reply: Reply, request: Request) -> BaseException:
        container = self._peer.address.container
        match reply.status:
            case Status.ERROR:
                return self._error(reply)
            case Status.BUSY:
                return Busy(service=self._label, container=container)
            case Status.EXPIRED:
                return DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
            case Status.GONE:
                return ServiceGone(service=self._label)
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
        except msgspec.DecodeError as bad:
            return RemoteError(service=self._label, type_name="an error that cannot be read", message=str(bad))


def _result_decoder(codec: Codec, info: ServiceInfo) -> Callable[[Any], Any]:
    """A decoder for the result, as typed as its description allows."""
    try:
        return codec.decoder(type_from_schema(info.result_schema, info.types))
    except Exception as bad:  # noqa: BLE001 - a schema from elsewhere may be anything
        _logger.debug("the result of %s stays plain data: %s", info.name, bad)
        return codec.decoder(Any)


def container_closed(own: Address) -> ConfigurationError:
    """What every use of a closed container raises."""
    return ConfigurationError(where=own.container, problem="this container is closed; start another one")
