"""Handles: values that name one service of one epoch."""

import asyncio
import inspect
import logging
import operator
from collections.abc import Callable, Mapping
from contextvars import Context
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Generic, NoReturn, ParamSpec, Protocol, TypeVar, cast

import msgspec

from trade._calls.run import Run
from trade._registry.registry import Record
from trade.errors import ConfigurationError
from trade.protocol.codec import Codec
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import Parameter, Scalar, encode_message
from trade.protocol.schema import read_schema, schema_name

if TYPE_CHECKING:
    from typing_extensions import ParamSpec as ParamSpecWithDefault  # every type checker has it
    from typing_extensions import TypeVar as TypeVarWithDefault

    _Arguments = ParamSpecWithDefault("_Arguments", default=...)
    _Result = TypeVarWithDefault("_Result", default=Any)
else:
    _Arguments = ParamSpec("_Arguments")
    _Result = TypeVar("_Result")

_P = ParamSpec("_P")
_R = TypeVar("_R")

_logger = logging.getLogger("trade")

LONGEST_DEADLINE_S: Final = 86_400.0
HANDLE_EXT: Final = 1
"""The number of the MessagePack extension in which handles travel."""


class CallHost(Protocol):
    """The container that made a handle, as the handle uses it. Implemented by `trade.Container`."""

    @property
    def address(self) -> Address: ...
    @property
    def closed(self) -> bool: ...
    def invoke(
        self, handle: "Handle", args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None
    ) -> Any: ...
    def begin(
        self, handle: "Handle", args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None
    ) -> "Run": ...
    def record(self, handle: "Handle") -> Record: ...
    def has(self, key: ServiceKey) -> bool: ...
    def asked_for(self, handle: "Handle") -> tuple[str, tuple[str, ...]]: ...


class _Doc:
    """The docstring of a class, and of each object the docstring of its service."""

    def __init__(self, of_class: str | None) -> None:
        self._of_class = of_class

    def __get__(self, handle: "Handle | None", owner: type) -> str | None:
        record = None if handle is None else handle.last_record
        if record is None:
            return self._of_class
        info = record.info
        return "\n\n".join(filter(None, (info.signature, info.doc, info.conditions)))


class Handle(Generic[_Arguments, _Result]):
    """One service of one epoch: call it, compare it, keep it, pass it as an argument or a result.

    A call raises ServiceGone after the service was deregistered, or its container ended or restarted. Type checkers
    know its arguments and its result if it belongs to a class that ``trade stubs`` wrote.
    """

    __doc__ = _Doc(__doc__)  # pyright: ignore[reportAssignmentType]  # for help() and shells

    __slots__ = ("_deadline_s", "_home", "_record", "key")
    __trade_type__: Final = "Handle"
    """Its name in JSON Schema."""

    def __init__(self, home: CallHost, key: ServiceKey, record: Record | None, deadline_s: float | None = None) -> None:
        self._home = home
        self.key = key
        """Its identity on the wire."""
        self._record = record
        self._deadline_s = deadline_s

    # --- calling

    def __call__(self, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        """Calls the service and waits for the result, at most until the deadline."""
        return self._home.invoke(self, args, kwargs, self._deadline_s)

    def start(self, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> "Run[_Result]":
        """Calls the service without waiting."""
        return self._home.begin(self, args, kwargs, self._deadline_s)

    async def acall(self, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        """Calls the service from asyncio. Cancelling the waiting task cancels the call, see `Run.cancel`."""
        run = self.start(*args, **kwargs)
        try:
            return await run
        except asyncio.CancelledError:
            if not run.done():
                Context().run(run.end_soon)
            raise

    def log_not_cancelled(self, error: BaseException) -> None:
        """Logs that a call of it could not be cancelled."""
        level = logging.DEBUG if self._home.closed else logging.WARNING
        _logger.log(level, "%s could not be cancelled: %s: %s", self.label, type(error).__name__, error)

    def with_(self, *, deadline_s: float) -> "Handle[_Arguments, _Result]":
        """The same service with other options for its calls.

        Args:
            deadline_s: how long a call may take, in seconds; more than zero, at most a day.
        """
        if not 0 < deadline_s <= LONGEST_DEADLINE_S:
            problem = f"deadline_s must be more than 0 and at most {LONGEST_DEADLINE_S:.0f} (a day), not {deadline_s}"
            raise ConfigurationError(problem=problem)
        return Handle(self._home, self.key, self._record, deadline_s)

    def bind(self, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> "BoundCall":
        """The call as a value, to be made later; its arguments are checked then."""
        return BoundCall(self, args, kwargs)

    # --- its description

    @property
    def record(self) -> Record:
        """Its registry entry, or the last known one. Raises ServiceGone if the registry never had the service."""
        self._record = self._home.record(self)
        return self._record

    @property
    def last_record(self) -> Record | None:
        """Its last known registry entry, if any."""
        return self._record

    @property
    def name(self) -> str:
        """The service's name."""
        return self.key.name

    @property
    def label(self) -> str:
        """Group and name, as on the command line."""
        return self._record.label if self._record else f"{self.key.domain}.{self.key.name}"

    @property
    def groups(self) -> tuple[str, ...]:
        """The provider's groups."""
        return self.record.groups

    @property
    def host(self) -> str:
        """The computer it runs on."""
        return self.record.host

    @property
    def container(self) -> str:
        """The name of its container."""
        return self.key.address.container

    @property
    def local(self) -> bool:
        """Whether it is in this same container."""
        return self.key.address == self._home.address

    @property
    def alive(self) -> bool:
        """Whether the registry has it now."""
        return self._home.has(self.key)

    @property
    def signature(self) -> str:
        """Name, arguments and result with their types."""
        return self.record.info.signature

    @property
    def __signature__(self) -> inspect.Signature:
        """The parameters, for `inspect.signature` and shells; the types are texts."""
        info = self.record.info
        schema = read_schema(info.arguments_schema)
        return inspect.Signature(
            [_parameter(one, schema.get("properties", {}).get(one.name, {})) for one in info.parameters]
        )

    @property
    def doc(self) -> str:
        """The method's docstring."""
        return self.record.info.doc

    @property
    def effect(self) -> str:
        """``read``, ``note``, ``actuate`` or ``stop``."""
        return self.record.info.effect

    @property
    def resources(self) -> tuple[str, ...]:
        """The resources that it needs exclusively."""
        return self.record.info.uses

    @property
    def needs(self) -> tuple[str, ...]:
        """Its pre-conditions."""
        return self.record.info.needs

    @property
    def achieves(self) -> tuple[str, ...]:
        """Its post-conditions."""
        return self.record.info.achieves

    @property
    def kinds(self) -> tuple[str, ...]:
        """The names of its provider's class, and of the bases and interfaces that have services."""
        return self.record.kinds

    @property
    def meta(self) -> Mapping[str, Scalar]:
        """Its metadata; the provider's values override those of its declaration."""
        return dict(self.record.meta)

    @property
    def health(self) -> str:
        """``healthy``, or the problem that its provider reports."""
        return self.record.health

    @property
    def verb(self) -> str:
        """The right over its first group that a caller needs: ``call``, ``read``...; empty: all may call it."""
        return self._home.asked_for(self)[0]

    @property
    def roles(self) -> tuple[str, ...]:
        """The roles that may call it by the policy of this container; empty if it requires none."""
        return self._home.asked_for(self)[1]

    @property
    def schema(self) -> Mapping[str, Mapping[str, Any]]:
        """The JSON Schemas of its ``arguments`` and ``result``."""
        info = self.record.info
        return {"arguments": read_schema(info.arguments_schema), "result": read_schema(info.result_schema)}

    def cancel_service(self) -> "Handle":
        """The service that cancels this one. Raises ConfigurationError if it has none."""
        cancel = self.record.info.cancel
        if cancel is None:
            raise ConfigurationError(
                where=self.label, problem="it cannot be cancelled, because its provider names no service for that"
            )
        key = ServiceKey(self.key.address, self.key.domain, self.key.provider, cancel)
        return Handle(self._home, key, None)

    # --- being a value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Handle) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    def __copy__(self) -> "Handle":
        return self

    def __deepcopy__(self, memo: object) -> "Handle":
        return self

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"{self!r} cannot be pickled: a handle belongs to its container. Give it to the other process as an "
            "argument or a result of a service, or look the service up there with trade.find(...)"
        )

    def __repr__(self) -> str:
        return f"<Handle {self.label} in {self.container}>"


def _parameter(described: Parameter, schema: Mapping[str, Any]) -> inspect.Parameter:
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    if described.keyword_only or described.positional_only:
        kind = inspect.Parameter.KEYWORD_ONLY if described.keyword_only else inspect.Parameter.POSITIONAL_ONLY
    default = inspect.Parameter.empty if described.required else schema.get("default", ...)
    return inspect.Parameter(described.name, kind, default=default, annotation=schema_name(schema))


class BoundCall:
    """A bound call: a handle with arguments. Call it, compare it, put it into a sequence."""

    __slots__ = ("args", "handle", "kwargs")

    def __init__(self, handle: Handle, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        self.handle = handle
        """The service."""
        self.args = args
        """Positional arguments."""
        self.kwargs = MappingProxyType(dict(kwargs))
        """Arguments by name."""

    def __call__(self) -> Any:
        """Makes the call and waits for the result."""
        return self.handle(*self.args, **self.kwargs)

    def start(self) -> Run:
        """Makes the call without waiting."""
        return self.handle.start(*self.args, **self.kwargs)

    async def acall(self) -> Any:
        """Makes the call from asyncio."""
        return await self.start()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BoundCall) and (self.handle, self.args, self.kwargs) == (
            other.handle,
            other.args,
            other.kwargs,
        )

    def __hash__(self) -> int:
        """Raises TypeError if an argument has no hash."""
        return hash((self.handle, self.args, frozenset(self.kwargs.items())))

    def __repr__(self) -> str:
        given = [*map(repr, self.args), *(f"{name}={value!r}" for name, value in self.kwargs.items())]
        return f"<Bound {self.handle.label}({', '.join(given)}) in {self.handle.container}>"


def handle_of(service: Callable[_P, _R], /) -> Handle[_P, _R]:
    """The handle of a service that type checkers know as a method: ``handle_of(arm.move_line).with_(deadline_s=60)``.

    Args:
        service: a service of an object that ``trade.find(JointGroup)`` returned, or a handle.

    Raises:
        ConfigurationError: it is no service.
    """
    return cast("Handle[_P, _R]", service_of(service, "trade.handle_of"))


def start_call(service: Callable[_P, _R], /, *args: _P.args, **kwargs: _P.kwargs) -> Run[_R]:
    """Calls a service without waiting: what ``service.start(...)`` does, with the types of its class.

    Args:
        service: a service of an object that ``trade.find(JointGroup)`` returned, or a handle.
        args: its positional arguments.
        kwargs: its arguments by name.

    Raises:
        ConfigurationError: it is no service.
    """
    return service_of(service, "trade.start_call").start(*args, **kwargs)


def service_of(service: object, function: str) -> Handle:
    """A service that is typed as a method, as the handle that it is. Raises ConfigurationError for anything else."""
    if not isinstance(service, Handle):
        problem = f"give a service that trade.find or trade.robot returned, not {service!r}"
        raise ConfigurationError(where=function, problem=problem)
    return cast("Handle", service)


def handle_codec(key_of: Callable[[Handle], ServiceKey], handle_of: Callable[[ServiceKey], Handle]) -> Codec:
    """A codec whose handles travel as the keys of their services.

    Args:
        key_of: returns the key to write for a handle; raises TypeError if the handle must not be sent.
        handle_of: returns the handle for a key; raises msgspec.ValidationError if it has none.
    """

    def to_data(value: Any) -> Any:
        if isinstance(value, Handle):
            return msgspec.msgpack.Ext(HANDLE_EXT, encode_message(key_of(cast("Handle", value))))
        if isinstance(value, float):  # a subclass of float, as in arrays
            return float(value)
        if hasattr(value, "__index__"):
            return operator.index(value)
        hint = "; send value.tolist()" if hasattr(value, "tolist") else ""
        raise TypeError(f"{type(value).__qualname__} is no plain data{hint}")

    def from_data(code: int, data: memoryview) -> Any:
        if code != HANDLE_EXT:
            raise msgspec.ValidationError(f"Unknown extension {code}")
        return handle_of(msgspec.msgpack.decode(data, type=ServiceKey))

    return Codec(to_data, from_data, (Handle,))
