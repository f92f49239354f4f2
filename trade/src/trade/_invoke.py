"""From a handle to a result: the same checks whether the service is here or elsewhere."""

import logging
import threading
from collections.abc import Callable
from functools import partial
from time import monotonic_ns
from typing import Any, Final

import msgspec
from msgspec import Raw, Struct

from trade._arguments import encode_arguments, encode_call, given
from trade._calls import Caller
from trade._codec import Codec
from trade._context import CallContext, Held, handed_down, holding, running
from trade._dispatch import LocalService
from trade._failures import unpack_error
from trade._handle import Run
from trade._ongoing import Ongoing
from trade._peer import Peer
from trade._records import type_from_schema
from trade._registry import Record
from trade._schemas import read_schema
from trade._serial import Serial, Turn
from trade._session import Session, speaking
from trade._system import CLOCK, DOMAIN, PROVIDER
from trade._wire import EMPTY_ARGUMENTS, Address, Behalf, Call, ErrorInfo, Reply, ServiceInfo, Status, Token
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
_DEFAULT_DEADLINE_NS: Final = int(DEFAULT_DEADLINE_S * 1e9)

_NOBODY: Final = Behalf()
_decode_error: Final = msgspec.msgpack.Decoder(ErrorInfo).decode


_Taken = bytes | tuple[tuple[Any, ...], dict[str, Any]]
"""The arguments of a strict call, and those of one that goes straight through."""


class Request(Struct, gc=False):
    """One call on its way out: deadline and chain, inherited from the call that makes it."""

    deadline_s: float
    deadline_ns: int
    chain: tuple[str, ...]
    asked_s: float
    """Without the outer call's deadline, which a stop does not heed: it is sent and waited for however late that is."""
    asked_ns: int
    outer: CallContext | None
    """The call that makes it."""
    around: tuple[Held, ...]
    """The locks it is made under."""
    client: Session | None
    """For whom it is made; none: the container itself."""

    def session(self, own: Address) -> str:
        """The client's session, if that container acts for one; else nothing.

        Raises:
            SessionEnded: the client is gone.
        """
        if self.client is None or self.client.owner != own:
            return ""
        self.client.check()
        return self.client.name

    def behalf(self, effect: str, own: Address) -> Behalf | None:
        """What the call inherits; the locks around it unless it stops, which needs none.

        Raises:
            LockLost: it actuates, and would do so under a lock that holds no more.
        """
        outer, around = self.outer, self.around
        if own in handed_down:
            around = (handed_down[own], *around)
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
        self.deadline_s, self.deadline_ns = self.asked_s, self.asked_ns


def new_request(deadline_s: float | None) -> Request:
    """A call that begins now."""
    now, outer, around, client = monotonic_ns(), running.get(), holding.get(), speaking.get()
    if deadline_s is None:
        asked_s, asked_ns = DEFAULT_DEADLINE_S, now + _DEFAULT_DEADLINE_NS
    else:
        asked_s, asked_ns = deadline_s, now + int(deadline_s * 1e9)
    if outer is None:
        return Request(asked_s, asked_ns, (), asked_s, asked_ns, None, around, client)
    chain = (*outer.chain, outer.service)
    if outer.expires_ns is None or outer.expires_ns >= asked_ns:
        return Request(asked_s, asked_ns, chain, asked_s, asked_ns, outer, around, client)
    left_s = max(0.0, (outer.expires_ns - now) / 1e9)
    return Request(left_s, outer.expires_ns, chain, asked_s, asked_ns, outer, around, client)


class LocalTarget:
    """A service of this container: called directly, with the validation and the copies a wire would make."""

    def __init__(
        self, service: LocalService, codec: Codec, own: Address, session: str, new_id: Callable[[], int]
    ) -> None:
        self._service = service
        self._codec = codec
        self._label = service.label
        self._is_stop = service.effect == "stop"
        self._straight = not service.strict and service.serial is None
        self._effect = service.effect
        self._own = own
        self._identity = own.identity
        self._session = session
        self._new_id = new_id

    def invoke(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Any:
        if self._straight:
            return self._service.call(args, kwargs, self._context(request, None))
        taken = self._taken(args, kwargs) if self._service.strict else (args, kwargs)
        if self._service.serial is None:
            return self._run(taken, request, None)
        return self._take_turn(self._service.serial, taken, request, None)

    def begin(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request, run: Run) -> None:
        """The same on a thread of its own, with the arguments as they are now."""
        service = self._service
        taken = self._taken(args, kwargs) if service.strict else (args, kwargs)

        def report(_: Ongoing, value: Any) -> None:
            run.note_progress(service.signature.copy_progress(service.label, value) if service.strict else value)

        ongoing = Ongoing(service, self._identity, None, report)
        run.on_cancel(ongoing.cancel)
        name = f"trade-run-{service.label}"
        if service.serial is None:
            outcome = partial(self._run, taken, request, ongoing)
        else:
            outcome = partial(self._take_turn, service.serial, taken, request, ongoing)
        threading.Thread(target=run.end, args=(outcome,), name=name, daemon=True).start()

    def _taken(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bytes:
        """The arguments as they are now, whatever becomes of them."""
        return encode_arguments(self._codec, self._service.info, self._service.label, args, kwargs)

    def _take_turn(self, serial: Serial, taken: _Taken, request: Request, ongoing: Ongoing | None) -> Any:
        if serial.mine:
            return self._run(taken, request, ongoing)
        turn = Turn()
        if ongoing is not None:
            ongoing.on_cancel(lambda: serial.drop(turn))
        if not serial.enter(turn, (request.deadline_ns - monotonic_ns()) / 1e9):
            if ongoing is not None and ongoing.cancelled:
                raise Cancelled(service=self._service.label)
            raise DeadlineExceeded(service=self._service.label, deadline_s=request.deadline_s)
        try:
            with serial.held():
                return self._run(taken, request, ongoing)
        finally:
            serial.leave()

    def _run(self, taken: _Taken, request: Request, ongoing: Ongoing | None) -> Any:
        service = self._service
        if ongoing is not None and ongoing.cancelled:
            raise Cancelled(service=service.label)
        context = self._context(request, ongoing)
        if isinstance(taken, tuple):
            return service.call(*taken, context)
        if service.signature.has_secrets:
            return self._discreet(taken, context)
        return self._copied(taken, context)

    def _context(self, request: Request, ongoing: Ongoing | None) -> CallContext:
        expires_ns = None if self._is_stop else request.deadline_ns
        if expires_ns is not None and monotonic_ns() >= expires_ns:
            raise DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
        behalf, session = request.behalf(self._effect, self._own), request.session(self._own) or self._session
        return CallContext(
            self._new_id(), self._label, self._identity, session, expires_ns, request.chain, ongoing, behalf
        )

    def _copied(self, raw: bytes, context: CallContext) -> Any:
        service = self._service
        return service.signature.copy_result(service.label, service.run(raw, context))

    def _discreet(self, raw: bytes, context: CallContext) -> Any:
        """An error as it would come over the wire: without what is secret."""
        try:
            return self._copied(raw, context)
        except Exception as error:  # noqa: BLE001 - whatever a provider raises
            masked = unpack_error(self._service.failure(error, raw), self._service.label)
        raise masked


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
        values = self._values(args, kwargs, request)
        if not self._may_go:
            reply = self._ask(self._clock, CLOCK, EMPTY_ARGUMENTS, None, request)
            if reply.status != Status.OK:
                raise self._not_begun(reply, request)
        reply = self._ask(self._publisher, self._info.name, values, self._expiry(request), request)
        return self._unpack(reply, request)

    def begin(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request, run: Run) -> None:
        """The same without waiting; the outcome goes into the run."""
        values = self._values(args, kwargs, request)

        def go() -> None:
            if run.cancelling:
                run.fail(Cancelled(service=self._label))
                return
            call_id = self._start(
                self._publisher, self._info.name, values, self._expiry(request), request, finish, note
            )
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

        if self._may_go:
            go()
        else:
            self._start(self._clock, CLOCK, EMPTY_ARGUMENTS, None, request, clock_heard)

    @property
    def _may_go(self) -> bool:
        """Whether nothing need be asked first."""
        return self._is_stop or self._peer.clock_known

    def _values(self, args: tuple[Any, ...], kwargs: dict[str, Any], request: Request) -> Any:
        """The arguments, for a message that is made now; as bytes, checked already, for one that comes later."""
        if self._is_stop:
            request.ignore_outer_deadline()
        elif request.deadline_s <= 0:
            raise DeadlineExceeded(service=self._label, deadline_s=request.deadline_s)
        if self._may_go:
            return given(self._info, self._label, args, kwargs)
        return Raw(encode_arguments(self._codec, self._info, self._label, args, kwargs))

    def _message(self, call: Call) -> bytes:
        return encode_call(self._codec, self._info, self._label, call)

    def _expiry(self, request: Request) -> int | None:
        return None if self._is_stop else self._peer.expiry_ns(request.deadline_ns)

    def _ask(self, publisher: Any, service: str, args: Any, expires_ns: int | None, request: Request) -> Reply:
        own, chain = self._caller.own, request.chain
        behalf, session = request.behalf(self._info.effect, own), request.session(own)
        return self._caller.ask(
            self._peer, publisher, service, args, request.deadline_ns, expires_ns, chain, behalf, self._message, session
        )

    def _start(
        self,
        publisher: Any,
        service: str,
        args: Any,
        expires_ns: int | None,
        request: Request,
        then: Callable[[Reply], None],
        on_progress: Callable[[Reply], None] | None = None,
    ) -> int:
        peer, deadline_ns, chain = self._peer, request.deadline_ns, request.chain
        own, encode = self._caller.own, self._message
        behalf, session = request.behalf(self._info.effect, own), request.session(own)
        return self._caller.start(
            peer, publisher, service, args, deadline_ns, expires_ns, chain, then, on_progress, behalf, encode, session
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
        return codec.decoder(type_from_schema(read_schema(info.result_schema), info.types))
    except Exception as bad:  # noqa: BLE001 - a schema from elsewhere may be anything
        _logger.debug("the result of %s stays plain data: %s", info.name, bad)
        return codec.decoder(Any)


def container_closed(own: Address) -> ConfigurationError:
    """What every use of a closed container raises."""
    return ConfigurationError(where=own.container, problem="this container is closed; start another one")
