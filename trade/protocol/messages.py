"""The messages on the wire, and the protocol version. docs/wire-protocol.md describes the same in prose."""

# pyright: reportUnknownVariableType=false

from sys import intern
from typing import Annotated, Any, Final, TypeVar
from weakref import WeakValueDictionary

import msgspec
from msgspec import Meta, Raw, Struct, structs

from trade.protocol.keys import is_chunk

PROTOCOL: Final = 1
"""The version of every message. A reader drops and counts messages of others, except orders to stop everything."""


class Token(Struct, frozen=True, array_like=True, gc=False):
    """Names one container's grant of a lock; travels with the calls made under the lock."""

    epoch: str
    """The epoch of the container that granted it."""
    number: int


class Behalf(Struct, frozen=True, array_like=True, gc=False):
    """What a call inherits from the calls that led to it, and from the locks around it."""

    sessions: tuple[str, ...] = ()
    """Further sessions it is made for, nearest first: its motion stops when one of them ends."""
    calls: tuple[int, ...] = ()
    """The calls that led to it, nearest first."""
    tokens: tuple[Token, ...] = ()


class Call(Struct, array_like=True, gc=False):
    """A request, published on ``call/...`` or ``stop/...``. The key contains the caller."""

    v: int
    id: int
    """Unique in the system: a random start per container plus a counter."""
    service: str
    reply: str
    """``container/channel`` of the caller's reply key."""
    session: str
    """The session of the caller: its address, and more chunks if it has several."""
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
    # Not an end: a progress message.
    PROGRESS: Final = 5
    # Published by the caller's own container on its own reply key, to end a wait.
    TIMED_OUT: Final = 6
    LOST: Final = 7
    CLOSED: Final = 8
    # Never published: the end of a call that could not be sent.
    UNSENT: Final = 9


class Reply(Struct, array_like=True, gc=False):
    """An answer, published on ``reply/...``."""

    v: int
    id: int
    status: Annotated[int, Meta(ge=0, le=8)]
    clock_ns: int
    """The callee's monotonic clock when it answered: keeps the caller's estimate of the offset fresh."""
    body: Raw
    """OK: the result. ERROR: an ErrorInfo. PROGRESS: the provider's value. Otherwise nil."""


class ErrorInfo(Struct):
    """An exception in its wire form."""

    type: str
    """``module:qualified name``."""
    message: str
    fields: dict[str, Any] = {}
    traceback: str = ""


Scalar = bool | int | float | str | None
"""The types of metadata values."""

HEALTHY: Final = "healthy"
"""The health of a provider without a fault; any other text describes the fault."""


class Parameter(Struct, frozen=True, array_like=True, gc=False):
    """One parameter of a service."""

    name: str
    required: bool = True
    keyword_only: bool = False
    positional_only: bool = False


_EFFECTS: Final = frozenset(["read", "note", "actuate", "stop"])
NO_SCHEMA: Final = Raw(msgspec.msgpack.encode({}))


class ServiceInfo(Struct, frozen=True, kw_only=True, omit_defaults=True, weakref=True):
    """The public description of a service. Equal ones from messages are one shared object: nothing changes it."""

    name: str
    signature: str
    doc: str = ""
    effect: str = "actuate"
    cancel: str | None = None
    needs: tuple[str, ...] = ()
    achieves: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    arguments_schema: Raw = NO_SCHEMA
    """JSON Schema in its wire form: few are ever read, see `schema`."""
    result_schema: Raw = NO_SCHEMA
    types: dict[str, str] = {}
    """Schema definition -> ``module:qualified name``, so that a process that has the type uses it."""
    meta: dict[str, Scalar] = {}

    @property
    def conditions(self) -> str:
        """Its pre-conditions and post-conditions, for people; empty if it has none."""
        known = (("needs", self.needs), ("achieves", self.achieves))
        return "; ".join(f"{word} {', '.join(texts)}" for word, texts in known if texts)


class Estop(Struct, frozen=True, array_like=True, gc=False):
    """An e-stop that is open until its id is cleared."""

    id: Annotated[str, Meta(min_length=1, max_length=80)]
    by: Annotated[str, Meta(max_length=300)]
    """The session that gave it."""
    reason: Annotated[str, Meta(max_length=500)]
    at: float
    """``time.time()`` there."""
    told_by: Annotated[str, Meta(max_length=300)] = ""
    """``identity/container`` of the container that reported it, if neither that nor its identity gave it; empty: this
    container received the order itself. The reporter may have invented it."""

    @property
    def giver(self) -> str:
        """The session that gave it and, if its order was not received here, the container that reported it."""
        return f"{self.by} (reported by {self.told_by})" if self.told_by else self.by


MOST_CLEARED: Final = 64
"""The largest number of e-stops that one order clears."""


class EstopOrder(Struct, array_like=True, gc=False):
    """Published on ``estop/<identity>`` until all have confirmed: opens one e-stop, or clears some.

    An order to open is obeyed in any version; an order to clear only in the reader's own.
    """

    v: int
    request: Annotated[str, Meta(min_length=1, max_length=80)]
    """The id of the order; of an e-stop, its id."""
    opened: Estop | None = None
    cleared: Annotated[tuple[str, ...], Meta(max_length=MOST_CLEARED)] = ()
    """More e-stops need several orders."""


class EstopConfirmed(Struct, array_like=True, gc=False):
    """Published on ``estop/<identity>/<container>/<epoch>`` once an order is carried out; equal in every version."""

    v: Annotated[int, Meta(ge=1)]
    request: str
    problem: str = ""
    """The part that failed."""


class ProviderInfo(Struct, frozen=True, kw_only=True):
    """A registry entry. Its key contains identity, container, epoch, domain and provider."""

    v: int = PROTOCOL
    revision: Annotated[int, Meta(ge=1, le=(1 << 63) - 1)]
    """Numbers the announcements of its container: one more than the previous one."""
    groups: tuple[str, ...]
    kind: str
    host: str
    pid: int
    services: tuple[ServiceInfo, ...]
    """Empty: the provider was deregistered."""
    kinds: tuple[str, ...] = ()
    """Names of its class and of the bases and interfaces that have services."""
    meta: dict[str, Scalar] = {}
    """Applies to all its services, and overrides their own."""
    health: str = HEALTHY
    members: dict[str, tuple[str, ...]] = {}
    """The robot's groups: group -> resources, whether or not they are present."""
    estops: tuple[Estop, ...] = ()
    """The open e-stops of a container, in the middleware's own provider; a reader takes the union of all."""
    moved_to: Annotated[str, Meta(max_length=500)] = ""  # the new place of a deregistered provider: see ServiceGone


class _ProviderMessage(ProviderInfo, frozen=True, kw_only=True):
    """The same before its services are decoded."""

    services: tuple[Raw, ...]  # pyright: ignore[reportIncompatibleVariableOverride]


class Tally(Struct, frozen=True, array_like=True, gc=False):
    """A container's current revision: the end of each reply, and published from time to time."""

    v: int
    revision: Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
    """The revision of its last announcement."""


CANCEL: Final = "cancel"
"""Cancels a call: a stop call of this name to the middleware's own provider. No registry contains it."""


class CancelArguments(Struct, array_like=True, gc=False):
    """The call to cancel."""

    id: int
    service: str
    keep_s: Annotated[float, Meta(ge=0, le=86_400)]
    """How long the call may still take to arrive."""


MOST_BYTES: Final = 64 << 20
"""The largest arguments and the largest result, encoded."""

LARGE: Final = 64 << 10
"""From this size on, bytes are worth a way on which they are copied less often."""

_MOST_MESSAGE_BYTES: Final = MOST_BYTES + (1 << 20)  # what is larger is not even decoded

EMPTY: Final = Raw(msgspec.msgpack.encode(None))
EMPTY_ARGUMENTS: Final = Raw(msgspec.msgpack.encode(()))


class LargeBytes:
    """A value of large bytes, in encoded form but not copied."""

    __slots__ = ("head", "value")

    def __init__(self, value: bytes) -> None:
        self.head: Final = b"\xc6" + len(value).to_bytes(4, "big")
        self.value: Final = value

    def __len__(self) -> int:
        return len(self.head) + len(self.value)


_Message = TypeVar("_Message", Call, Reply, _ProviderMessage, Tally, EstopOrder)
_Value = TypeVar("_Value")


UNREADABLE: Final = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""Errors of decoding foreign values: another type, invalid text, or too much nesting."""


class Malformed(Exception):
    """Bytes that are not a message of this protocol version; dropped, never answered."""


class OtherVersion(Malformed):
    """A message of another protocol version."""

    def __init__(self, version: int) -> None:
        super().__init__(f"protocol version {version}, this is {PROTOCOL}; update the older side")
        self.version = version


NO_CHUNK: Final = "an e-stop's id is one chunk"
"""The id is also the name of a file."""

call_decoder: Final = msgspec.msgpack.Decoder(Call)
reply_decoder: Final = msgspec.msgpack.Decoder(Reply)
_provider_decoder: Final = msgspec.msgpack.Decoder(_ProviderMessage)
_service_decoder: Final = msgspec.msgpack.Decoder(ServiceInfo)
_services: Final[WeakValueDictionary[bytes, ServiceInfo]] = WeakValueDictionary()
"""The current services by their bytes: a thousand objects of one class have equal descriptions."""
_tally_decoder: Final = msgspec.msgpack.Decoder(Tally)
encode_message: Final = msgspec.msgpack.Encoder().encode


def decode_call(payload: bytes) -> Call:
    """A call; raises Malformed."""
    return decoded(call_decoder, payload)


def decode_reply(payload: bytes) -> Reply:
    """A reply; raises Malformed."""
    return decoded(reply_decoder, payload)


def decode_provider(payload: bytes) -> ProviderInfo:
    """A provider's entry with its services; raises Malformed."""
    message = decoded(_provider_decoder, payload)
    try:
        services = tuple(_service(bytes(raw)) for raw in message.services)
    except (msgspec.DecodeError, ValueError, RecursionError, MemoryError) as bad:
        raise unread(payload, bad) from None
    if not all(is_chunk(estop.id) for estop in message.estops):
        raise Malformed(NO_CHUNK)
    fields: dict[str, Any] = {
        **structs.asdict(message),
        "services": services,
        "kind": intern(message.kind),
        "host": intern(message.host),
        "kinds": tuple(map(intern, message.kinds)),
    }
    return ProviderInfo(**fields)


def _service(data: bytes) -> ServiceInfo:
    known = _services.get(data)
    return known if known is not None else _services.setdefault(data, _understood(_service_decoder.decode(data)))


def _understood(info: ServiceInfo) -> ServiceInfo:
    """Treats an unknown effect, of a later version or another language, as one that may move something."""
    return info if info.effect in _EFFECTS else structs.replace(info, effect="actuate")


def decode_tally(payload: bytes) -> Tally:
    """A container's revision; raises Malformed."""
    return decoded(_tally_decoder, payload)


def decoded(decoder: msgspec.msgpack.Decoder[_Message], payload: bytes) -> _Message:
    """A message of this version. Raises Malformed."""
    message = read_any(decoder, payload)
    if message.v != PROTOCOL:
        raise OtherVersion(message.v)
    return message


def read_any(decoder: msgspec.msgpack.Decoder[_Value], payload: bytes) -> _Value:
    """A message of any version. Raises Malformed."""
    if len(payload) > _MOST_MESSAGE_BYTES:
        raise Malformed(f"a message of {len(payload)} bytes exceeds the limit of {_MOST_MESSAGE_BYTES} bytes")
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError, MemoryError) as bad:
        raise unread(payload, bad) from None


def unread(payload: bytes, bad: Exception) -> Malformed:
    """Why bytes were dropped: distinguishes another version from garbage."""
    try:
        raw: Any = msgspec.msgpack.decode(payload)
        version: Any = raw[0] if isinstance(raw, list) else raw.get("v")
    except Exception:  # noqa: BLE001 - the bytes are anything
        version = None
    if isinstance(version, int) and not isinstance(version, bool) and version != PROTOCOL:
        return OtherVersion(version)
    return Malformed(f"not a message of this protocol: {bad}")
