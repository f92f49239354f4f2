"""A service of this container: validating, admitting and running one call of it."""

import asyncio
import time
from collections.abc import Callable, Sequence
from functools import partial
from types import CoroutineType
from typing import Any, Final

from msgspec import Raw, structs

from trade._context.call_context import CallContext, running
from trade._context.interceptor import CallGuard, Interceptor, ServedCall
from trade._context.sessions import foreign
from trade._resources.resource import Resource, admitted
from trade._security.policy import Policy
from trade._services.decorator import ServiceMark
from trade._services.event_loop import AsyncLoop
from trade._services.serial_queue import SerialQueue
from trade._services.signature import Signature
from trade.errors import DeadlineExceeded, TradeError
from trade.protocol.messages import ErrorInfo, ServiceInfo
from trade.protocol.remote_errors import pack_error, unpack_error

_COROUTINE: Final[type] = CoroutineType
"""The type that an ``async def`` returns; compared with every result, hence cheap."""


class LocalService:
    """A method of a registered provider, ready to be called."""

    __slots__ = (
        "_loop",
        "admitted",
        "check",
        "effect",
        "guards",
        "info",
        "interceptors",
        "label",
        "method",
        "quick",
        "resources",
        "serial",
        "signature",
        "strict",
    )

    def __init__(
        self,
        label: str,
        info: ServiceInfo,
        signature: Signature,
        method: Callable[..., Any],
        mark: ServiceMark,
        loop: AsyncLoop,
        serial: SerialQueue | None,
        resources: tuple[Resource, ...] = (),
    ) -> None:
        self.label = label
        self.info = info
        self.signature = signature
        self.method = method
        self.effect = mark.effect
        self.strict = mark.strict
        self.serial = serial
        self.resources = resources
        """Resources that it needs exclusively, or stops."""
        self.interceptors: tuple[Interceptor, ...] = ()
        """The interceptors called around it, the outermost first."""
        self.check: Callable[[Any], Any] | None = None
        """The check of ``@service(guard=...)``, bound to the provider."""
        self.guards: tuple[CallGuard, ...] = ()
        """What may refuse its calls; the innermost, so that a stop meanwhile ends them."""
        self.admitted: dict[str, Policy] = {}
        """The identities that may call it, each with the policy that allowed it."""
        self.quick = False
        """Whether it took little time when it was last called on a connection for started calls."""
        self._loop = loop

    def run(self, raw: Raw | bytes, context: CallContext) -> Any:
        """Validate the arguments, then call. Raises what the provider raises."""
        try:
            args, kwargs = self.signature.decode(self.label, raw)
        except TradeError as error:
            for interceptor in self.interceptors:
                interceptor.rejected(ServedCall(self, (), {}, context), error)
            raise
        return self.call(args, kwargs, context)

    def call(
        self,
        args: Sequence[Any],
        kwargs: dict[str, Any],
        context: CallContext,
        inside: tuple[Interceptor, ...] | None = None,
    ) -> Any:
        """Call with the arguments as they are, through all interceptors, or those ``inside`` the running one."""
        interceptors = self.interceptors if inside is None else inside  # others may be attached at any time
        if interceptors:
            proceed = partial(self.call, args, kwargs, context, interceptors[1:])
            return interceptors[0].run(ServedCall(self, args, kwargs, context), proceed)
        if not self.resources or self.effect != "actuate":
            self._look(context)
            if self.guards:
                self._require_passed(args, kwargs, context)
            return self.run_admitted(args, kwargs, context)
        permit = admitted(self.resources, context)
        try:
            if self.guards:
                self._require_passed(args, kwargs, context)
                permit.gate()
            return self.run_admitted(args, kwargs, context)
        finally:
            permit.close()
            structs.force_setattr(context, "permit", None)

    def _require_passed(self, args: Sequence[Any], kwargs: dict[str, Any], context: CallContext) -> None:
        """Raises what its guards raise, or why the call may not begin any more after they took their time."""
        began_ns = time.monotonic_ns()
        for guard in self.guards:
            guard.require(ServedCall(self, args, kwargs, context))
        if self.too_late(context.expires_ns):
            raise DeadlineExceeded(service=self.label, deadline_s=(time.monotonic_ns() - began_ns) / 1e9)

    def _look(self, context: CallContext) -> None:
        """Stop first, if it stops; check the lock that a reading service may have under its own handle."""
        for resource in self.resources:
            if self.effect == "stop":
                resource.stop(foreign(context.session) or context.caller, context.sessions)
            elif resource.guarded or context.behalf is not None:
                resource.check_lock(context.tokens, context.caller, context.session)

    def run_admitted(self, args: Sequence[Any], kwargs: dict[str, Any], context: CallContext) -> Any:
        """Call with checked arguments and no more checks: it holds its resources, or it stops them."""
        token = running.set(context)
        try:
            result = self.method(*args, **kwargs) if kwargs else self.method(*args)
            return self._loop.complete(result, context) if type(result) is _COROUTINE else result
        except (SystemExit, GeneratorExit, asyncio.CancelledError) as error:  # from the provider, not for this thread
            raise unpack_error(pack_error(error), self.label) from error
        finally:
            running.reset(token)
            if context.behalf is not None:  # tasks that it left running inherit nothing any more
                structs.force_setattr(context, "behalf", None)

    def failure(self, error: BaseException, raw: Raw | bytes) -> ErrorInfo:
        """The error of a call with these arguments, as its caller receives it."""
        info = pack_error(error)
        return self.signature.without_secrets(info, raw) if self.signature.has_secrets else info

    def too_late(self, expires_ns: int | None) -> bool:
        """Whether the call has expired. A stop never expires; a command of unknown expiry always has."""
        if self.effect == "stop":
            return False
        if expires_ns is None:
            return self.effect != "read"
        return time.monotonic_ns() >= expires_ns
