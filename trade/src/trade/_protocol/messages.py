"""What goes over the wire: keys, messages, the protocol version. docs/wire-protocol.md says the same in prose."""

# pyright: reportUnknownVariableType=false

from sys import intern
from typing import Annotated, Any, Final, TypeVar
from weakref import WeakValueDictionary

import msgspec
from msgspec import Meta, Raw, Struct, structs

from trade._protocol.keys import is_chunk

PROTOCOL: Final = 1
"""Version of every message. A reader drops and counts what carries another, except what says that all is to stop."""


class Token(Struct, frozen=True, array_like=True, gc=False):
    """Names a lock's grant by one container; travels with the calls made under the lock."""

    epoch: str
    """Of the container that granted."""
    number: int


class Behalf(Struct, frozen=True, array_like=True, gc=False):
    """What a call inherits from those that led to it, and from the locks around it."""

    sessions: tuple[str, ...] = ()
    """For whom else it is made, nearest first: what it moves stops when one of them ends."""
    calls: tuple[int, ...] = ()
    """The calls that led to it, nearest first."""
    tokens: tuple[Token, ...] = ()


class Call(Struct, array_like=True, gc=False):
    """A request, put on ``call/...`` or ``stop/...``. Who asks stands in the key."""

    v: int
    id: int
    """Unique in the system: a random start per container plus a counter."""
    service: str
    reply: str
    """``container/channel`` of the caller's reply key."""
    session: str
    """Of who asks: its address, and more chunks if it has several."""
    expires_ns: int | None
    """In the callee's monotonic clock; None only where being late is harmless (reading, stopping)."""
    chain: tuple[str, ...]
    """Services whose calls led to this one, outermost first."""
    args: Raw
    """Positional arguments as an array, or all arguments by name as a map."""
    behalf: Behalf | None = None


class Status:
    """How a call ended."""

    OK: Final = 0
    ERROR: Final = 1
    BUSY: Final = 2
    EXPIRED: Final = 3
    GONE: Final = 4
    # No end: how far it is.
    PROGRESS: Final = 5
    # Put by the caller's own container on its own reply key, to end a wait.
    TIMED_OUT: Final = 6
    LOST: Final = 7
    CLOSED: Final = 8
    # Never put at all: what a call ends with that could not be sent.
    UNSENT: Final = 9


class Reply(Struct, array_like=True, gc=False):
    """An answer, put on ``reply/...``."""

    v: int
    id: int
    status: Annotated[int, Meta(ge=0, le=8)]
    clock_ns: int
    """The callee's monotonic clock when it answered: keeps the caller's estimate of the offset fresh."""
    body: Raw
    """OK: the result. ERROR: an ErrorInfo. PROGRESS: whatever the provider says. Otherwise nil."""


class ErrorInfo(Struct):
    """An exception on its way to the caller."""

    type: str
    """``module:qualified name``."""
    message: str
    fields: dict[str, Any] = {}
    traceback: str = ""


Scalar = bool | int | float | str | None
"""What metadata may be."""

HEALTHY: Final = "healthy"
"""The health of a provider with which nothing is wrong; any other text says what is."""


class Parameter(Struct, frozen=True, array_like=True, gc=False):
    """One parameter of a service."""

    name: str
    required: bool = True
    keyword_only: bool = False
    positional_only: bool = False


_EFFECTS: Final = frozenset(["read", "note", "actuate", "stop"])
NO_SCHEMA: Final = Raw(msgspec.msgpack.encode({}))


class ServiceInfo(Struct, frozen=True, kw_only=True, omit_defaults=True, weakref=True):
    """What everybody may know of a service. Equal ones that came by message are one object: nobody changes it."""

    name: str
    signature: str
    doc: str = ""
    effect: str = "actuate"
    cancel: str | None = None
    achieves: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    arguments_schema: Raw = NO_SCHEMA
    """JSON Schema as it travels: few are ever looked at, see `schema`."""
    result_schema: Raw = NO_SCHEMA
    types: dict[str, str] = {}
    """Schema definition -> ``module:qualified name``, so that a process that has the type gets the type."""
    meta: dict[str, Scalar] = {}


class Estop(Struct, frozen=True, array_like=True, gc=False):
    """An e-stop that is open until somebody clears its id."""

    id: Annotated[str, Meta(min_length=1, max_length=80)]
    by: Annotated[str, Meta(max_length=300)]
    """The session of who gave it."""
    reason: Annotated[str, Meta(max_length=500)]
    at: float
    """``time.time()`` there."""
    told_by: Annotated[str, Meta(max_length=300)] = ""
    """``identity/container`` of who told of it, if that is not its giver, nor of the giver's identity; empty: its order
    was heard. Who told may have made it up."""

    @property
    def giver(self) -> str:
        """Who gave it and, where it was not heard from him, who says so."""
        return f"{self.by} (told by {self.told_by})" if self.told_by else self.by


MOST_CLEARED: Final = 64
"""By one order."""


class EstopOrder(Struct, array_like=True, gc=False):
    """Put on ``estop/<identity>`` until all have confirmed: one e-stop is opened, or some are cleared.

    One that opens is obeyed whatever its version; one that clears is of the reader's own.
    """

    v: int
    request: Annotated[str, Meta(min_length=1, max_length=80)]
    """Names the order; of an e-stop, its id."""
    opened: Estop | None = None
    cleared: Annotated[tuple[str, ...], Meta(max_length=MOST_CLEARED)] = ()
    """More are cleared by several orders."""


class EstopConfirmed(Struct, array_like=True, gc=False):
    """Put on ``estop/<identity>/<container>/<epoch>`` by who did what an order says; the same in every version."""

    v: Annotated[int, Meta(ge=1)]
    request: str
    problem: str = ""
    """What of it failed."""


class ProviderInfo(Struct, frozen=True, kw_only=True):
    """A registry entry. Identity, container, epoch, domain and provider stand in its key."""

    v: int = PROTOCOL
    revision: Annotated[int, Meta(ge=1, le=(1 << 63) - 1)]
    """Counts everything its container announces: one more than what that announced before."""
    groups: tuple[str, ...]
    kind: str
    host: str
    pid: int
    services: tuple[ServiceInfo, ...]
    """None of them: the provider was deregistered."""
    kinds: tuple[str, ...] = ()
    """Names of its class and of the bases and interfaces that have services."""
    meta: dict[str, Scalar] = {}
    """Holds for all its services, over what they say themselves."""
    health: str = HEALTHY
    members: dict[str, tuple[str, ...]] = {}
    """What the robot's groups consist of: group -> resources, whether or not they are there."""
    estops: tuple[Estop, ...] = ()
    """Of the middleware's own provider: what is open in its container; who hears it takes the union."""
    moved_to: Annotated[str, Meta(max_length=500)] = ""  # where one that was deregistered goes on: see ServiceGone


class _ProviderMessage(ProviderInfo, frozen=True, kw_only=True):
    """The same before its services are read."""

    services: tuple[Raw, ...]  # pyright: ignore[reportIncompatibleVariableOverride]


class Tally(Struct, frozen=True, array_like=True, gc=False):
    """How far a container is: the last thing it says in an answer, and what it says now and then."""

    v: int
    revision: Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
    """Of what it announced last."""


CANCEL: Final = "cancel"
"""Asks to end a call: a stop call of this name to the middleware's own provider. It stands in no registry."""


class CancelArguments(Struct, array_like=True, gc=False):
    """Which call to end."""

    id: int
    service: str
    keep_s: Annotated[float, Meta(ge=0, le=86_400)]
    """How long the call may still be under way."""


MOST_BYTES: Final = 64 << 20
"""The largest arguments and the largest result, encoded."""

_MOST_MESSAGE_BYTES: Final = MOST_BYTES + (1 << 20)  # what is larger is not even decoded

EMPTY: Final = Raw(msgspec.msgpack.encode(None))
EMPTY_ARGUMENTS: Final = Raw(msgspec.msgpack.encode(()))

_Message = TypeVar("_Message", Call, Reply, _ProviderMessage, Tally, EstopOrder)
_Value = TypeVar("_Value")


UNREADABLE: Final = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What decoding of values from elsewhere raises: another type, text that is none, nested too deeply."""


class Malformed(Exception):
    """Bytes that are no message of this protocol version; dropped, never answered."""


class OtherVersion(Malformed):
    """A message of another protocol version."""

    def __init__(self, version: int) -> None:
        super().__init__(f"protocol version {version}, this is {PROTOCOL}; update the older side")
        self.version = version


NO_CHUNK: Final = "an e-stop's id is one chunk"
"""It names a file, too."""

call_decoder: Final = msgspec.msgpack.Decoder(Call)
reply_decoder: Final = msgspec.msgpack.Decoder(Reply)
_provider_decoder: Final = msgspec.msgpack.Decoder(_ProviderMessage)
_service_decoder: Final = msgspec.msgpack.Decoder(ServiceInfo)
_services: Final[WeakValueDictionary[bytes, ServiceInfo]] = WeakValueDictionary()
"""The services known now by their bytes: a thousand objects of one class tell the same."""
_tally_decoder: Final = msgspec.msgpack.Decoder(Tally)
encode_message: Final = msgspec.msgpack.Encoder().encode


def decode_call(payload: bytes) -> Call:
    return decoded(call_decoder, payload)


def decode_reply(payload: bytes) -> Reply:
    return decoded(reply_decoder, payload)


def decode_provider(payload: bytes) -> ProviderInfo:
    message = decoded(_provider_decoder, payload)
    try:
        services = tuple(_service(bytes(raw)) for raw in message.services)
    except (msgspec.DecodeError, ValueError, RecursionError, MemoryError) as bad:
        raise unread(payload, bad) from None
    if not all(is_chunk(estop.id) for estop in message.estops):
        raise Malformed(NO_CHUNK)
    told: dict[str, Any] = {
        **structs.asdict(message),
        "services": services,
        "kind": intern(message.kind),
        "host": intern(message.host),
    }
    return ProviderInfo(**told)


def _service(data: bytes) -> ServiceInfo:
    known = _services.get(data)
    return known if known is not None else _services.setdefault(data, _understood(_service_decoder.decode(data)))


def _understood(info: ServiceInfo) -> ServiceInfo:
    """What has an effect that is not known, of a later version or another language, may move something."""
    return info if info.effect in _EFFECTS else structs.replace(info, effect="actuate")


def decode_tally(payload: bytes) -> Tally:
    return decoded(_tally_decoder, payload)


def decoded(decoder: msgspec.msgpack.Decoder[_Message], payload: bytes) -> _Message:
    """A message of this version. Raises Malformed."""
    message = read_any(decoder, payload)
    if message.v != PROTOCOL:
        raise OtherVersion(message.v)
    return message


def read_any(decoder: msgspec.msgpack.Decoder[_Value], payload: bytes) -> _Value:
    """A message of whatever version. Raises Malformed."""
    if len(payload) > _MOST_MESSAGE_BYTES:
        raise Malformed(f"{len(payload)} bytes are more than any message may have ({_MOST_MESSAGE_BYTES})")
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError, MemoryError) as bad:
        raise unread(payload, bad) from None


def unread(payload: bytes, bad: Exception) -> Malformed:
    """Why bytes are dropped that are no message of this version: another one is worth telling from garbage."""
    try:
        raw: Any = msgspec.msgpack.decode(payload)
        version: Any = raw[0] if isinstance(raw, list) else raw.get("v")
    except Exception:  # noqa: BLE001 - the bytes are anything
        version = None
    if isinstance(version, int) and not isinstance(version, bool) and version != PROTOCOL:
        return OtherVersion(version)
    return Malformed(f"not a message of this protocol: {bad}")
