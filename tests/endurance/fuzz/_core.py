"""What containers say to each other: messages, keys, arguments, errors, constraints."""

from collections.abc import Callable
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from msgspec import Meta, Raw, Struct

from tests.endurance.fuzz._target import Target
from trade import Constraint, Handle, Secret, service
from trade._calls.handle import handle_codec
from trade._discovery.listener import _place as place_of
from trade._locks.inherited import InheritedLock
from trade._registry.predicates import fits_all, parse_predicates
from trade._services.decorator import marked_methods
from trade._services.signature import Signature
from trade.errors import ConfigurationError, InvalidArgument, TradeError
from trade.protocol.estop_messages import decode_estop_confirmed, decode_estop_order, decode_open_estops
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import (
    UNREADABLE,
    ErrorInfo,
    Malformed,
    Parameter,
    ServiceInfo,
    decode_call,
    decode_provider,
    decode_reply,
    decode_tally,
    encode_message,
)
from trade.protocol.remote_errors import pack_error, unpack_error
from trade.protocol.samples import decode_sample
from trade.transport.endpoints import Endpoint
from trade.transport.scouting import read_hello

ME: Final = Address("anna", "kitchen", "e1")


class Place(Struct):
    x: float
    y: Annotated[float, Meta(ge=0, le=1)] = 0.0


class Desk:
    """Services with one of each kind of argument."""

    @service
    def turn(self, angle_rad: Annotated[float, Meta(ge=-1, le=1)], *, speed: float = 1.0) -> float:
        return angle_rad * speed

    @service
    def put(self, place: Place, names: dict[str, list[int | str]], by: tuple[bytes, ...] = ()) -> None: ...

    @service(effect="read")
    def match(self, which: Constraint, handle: Handle | None = None, anything: Any = None) -> bool:
        return True

    @service
    def sign(self, token: Secret[str], length: int = 0) -> None: ...


class Candidate(NamedTuple):
    """A service that constraints are asked about."""

    info: ServiceInfo
    name: str = "open"
    groups: tuple[str, ...] = ("rosie.hand",)
    host: str = "h"
    container: str = "c"
    local: bool = True
    kinds: tuple[str, ...] = ("Hand",)
    meta: dict[str, Any] = {"a": 1}  # noqa: RUF012 - a record of a test
    healthy: bool = True


CANDIDATE: Final = Candidate(
    ServiceInfo(
        name="open",
        signature="open(width: float)",
        parameters=(Parameter("width"),),
        achieves=("open(gripper)", "at(gripper, 1)", "held(cup, left)"),
        uses=("hand",),
    )
)


def _no_handle(key: ServiceKey) -> Handle:
    raise msgspec.ValidationError(f"there is no {key}")


_CODEC: Final = handle_codec(lambda handle: handle.key, _no_handle)
_SIGNATURES: Final = [
    (name, Signature("Desk", name, mark, function, _CODEC)) for name, (mark, function) in marked_methods(Desk).items()
]


def _arguments(data: bytes) -> Any:
    """The first byte says of which service."""
    name, signature = _SIGNATURES[data[0] % len(_SIGNATURES)] if data else _SIGNATURES[0]
    try:
        msgspec.msgpack.decode(data[1:], type=Raw)  # a call has arguments that are whole
    except UNREADABLE as bad:
        raise Malformed(str(bad)) from None
    try:
        return signature.decode(name, data[1:])
    except InvalidArgument as refused:
        signature.without_secrets(pack_error(refused), data[1:])
        raise


def _error(data: bytes) -> Any:
    """As a caller has it: raised, shown, and passed on."""
    info = msgspec.msgpack.decode(data, type=ErrorInfo)
    error = unpack_error(info, "rosie.turn")
    assert isinstance(error, Exception)
    assert isinstance(repr(error), str)
    pack_error(error)
    if isinstance(error, TradeError):
        assert isinstance(str(error), str)
    return info


_CONSTRAINTS: Final = msgspec.msgpack.Decoder(Constraint)


def _constraint(data: bytes) -> Constraint:
    read = _CONSTRAINTS.decode(data)
    read.matches(CANDIDATE)
    assert isinstance(str(read), str)
    return read


def _constraint_written(read: Constraint) -> bytes:
    """In order: sets have none."""
    return encode_message({"clauses": [sorted(clause) for clause in read.clauses]})


def _predicates(data: bytes) -> tuple[Any, ...]:
    """Patterns, and behind a line's end facts."""
    wanted, _, facts = data.decode(errors="replace").partition("\n")
    patterns = parse_predicates(wanted)
    fits_all(facts.split("\n"), patterns)
    fits_all([wanted], patterns)
    return patterns


def _text(read: Callable[[str], Any]) -> Callable[[bytes], Any]:
    return lambda data: read(data.decode(errors="replace"))


def _inherited(text: str) -> list[Any]:
    return InheritedLock(text, ME).tokens()


TARGETS: Final = [
    Target("wire-call", decode_call, (Malformed,), encode_message),
    Target("wire-reply", decode_reply, (Malformed,), encode_message),
    Target("wire-provider", decode_provider, (Malformed,), encode_message),
    Target("wire-tally", decode_tally, (Malformed,), encode_message),
    Target("wire-sample", decode_sample, (Malformed,), encode_message),
    Target("wire-estop-order", lambda data: decode_estop_order(data, "anna"), (Malformed,), encode_message),
    Target("wire-estop-confirmed", decode_estop_confirmed, (Malformed,), encode_message),
    Target("wire-open-estops", decode_open_estops, (Malformed,), lambda reported: encode_message({"estops": reported})),
    Target("wire-error", _error, UNREADABLE, encode_message),
    Target("wire-arguments", _arguments, (InvalidArgument, Malformed)),
    Target("wire-key", _text(place_of), (Malformed,)),
    Target("constraint", _constraint, UNREADABLE, _constraint_written),
    Target("predicates", _predicates, (ConfigurationError,), lambda found: ", ".join(map(str, found)).encode()),
    Target("endpoint", _text(Endpoint.read), (ConfigurationError,), lambda read: str(read).encode()),
    Target("hello", read_hello),
    Target("inherited-lock", _text(_inherited), (ConfigurationError,)),
]
