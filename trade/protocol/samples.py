"""One sample of a stream: in its wire form, and as a listener gets it."""

from typing import TYPE_CHECKING, Annotated, Any, Final, Generic

import msgspec
from msgspec import Meta, Raw, Struct

from trade.protocol.keys import ServiceKey
from trade.protocol.messages import MOST_BYTES, PROTOCOL, Malformed, OtherVersion, unread

STREAMS: Final = "stream/**"
STEPS_HZ: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""A gateway that limits rates forwards streams at one of these, or more slowly than the first."""
_MOST_MESSAGE_BYTES: Final = MOST_BYTES + (1 << 20)


if TYPE_CHECKING:
    from typing_extensions import TypeVar  # every type checker has it

    Value = TypeVar("Value", default=Any)
else:
    from typing import TypeVar

    Value = TypeVar("Value")


class Sample(Struct, Generic[Value], frozen=True, kw_only=True):
    """The result of a service at one moment."""

    value: Value
    at: float
    """``time.time()`` of the source when the service was called."""
    at_ns: int
    """``time.monotonic_ns()`` of the source at that moment: for intervals between samples of one stream."""
    number: int
    """Counts the samples that the source has published at this rate, from 1."""
    dropped: int = 0
    """How many are missing since the previous one: not taken in time, or lost in transit. Samples that were never
    published at this rate, the listener's own or that of a gateway between, are not counted. Whether the missing ones
    would have met the condition is unknown."""


class StreamSample(Struct, frozen=True, array_like=True, gc=False):
    """Published on the key of a stream, for all its listeners at once."""

    v: int
    number: Annotated[int, Meta(ge=1, le=(1 << 63) - 1)]
    at: float
    at_ns: int
    failed: bool
    """Whether the service ended with an error."""
    body: Raw
    """The result, or an ErrorInfo."""


_decoder: Final = msgspec.msgpack.Decoder(StreamSample)


def stream_key(service: ServiceKey, hz: float) -> str:
    """The key of a service's samples at a rate.

    At the rates of ``STEPS_HZ``, a source also publishes signs of life on this key, so they reach the same listeners.
    """
    return f"{_all_rates(service)}/{hz:g}"


def signs_of(service: ServiceKey) -> str:
    """The pattern of all signs of a source."""
    return f"{_all_rates(service)}/*"


def _all_rates(service: ServiceKey) -> str:
    return f"stream/{service.domain}/{service.address}/{service.provider}/{service.name}"


def rate_of(sign: str) -> float:
    """The rate of a sign; 0 if it is not one."""
    text = sign.rpartition("/")[2]
    return float(text) if text.isdecimal() else 0.0


def decode_sample(payload: bytes) -> StreamSample:
    """Raises Malformed."""
    if len(payload) > _MOST_MESSAGE_BYTES:
        raise Malformed(f"a message of {len(payload)} bytes exceeds the limit of {_MOST_MESSAGE_BYTES} bytes")
    try:
        sample = _decoder.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError, MemoryError) as bad:
        raise unread(payload, bad) from None
    if sample.v != PROTOCOL:
        raise OtherVersion(sample.v)
    return sample
