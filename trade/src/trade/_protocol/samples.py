"""One sample of a stream: as it travels, and as a listener is given it."""

from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Raw, Struct

from trade._protocol.keys import ServiceKey
from trade._protocol.messages import MOST_BYTES, PROTOCOL, Malformed, OtherVersion, unread

__all__ = [
    "STEPS_HZ",
    "STREAMS",
    "Sample",
    "StreamSample",
    "decode_sample",
    "rate_of",
    "signs_of",
    "stream_key",
]

STREAMS: Final = "stream/**"
STEPS_HZ: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Through a gateway that limits rates, streams go at one of these, or more slowly than the first."""
_MOST_MESSAGE_BYTES: Final = MOST_BYTES + (1 << 20)


class Sample(Struct, frozen=True, kw_only=True):
    """What a service answered at a moment."""

    value: Any
    at: float
    """``time.time()`` of the source, when it was asked."""
    at_ns: int
    """``time.monotonic_ns()`` of the source at that moment: for intervals between samples of one stream."""
    number: int
    """Of the samples that the source has put at this rate, counted from 1."""
    dropped: int = 0
    """How many are missing since the one before: not taken in time, or lost on the way. What was never put at this
    rate, the listener's own or that of a gateway between, is not missing. Whether they would have met the condition
    nobody knows."""


class StreamSample(Struct, frozen=True, array_like=True, gc=False):
    """Put on the key of a stream for all its listeners at once."""

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
    """Where the samples of a service are put for those who want so many a second.

    On the keys of the steps a source also shows that it can be heard: its signs reach those whom its samples reach.
    """
    return f"{_all_rates(service)}/{hz:g}"


def signs_of(service: ServiceKey) -> str:
    """All signs of a source."""
    return f"{_all_rates(service)}/*"


def _all_rates(service: ServiceKey) -> str:
    return f"stream/{service.domain}/{service.address}/{service.provider}/{service.name}"


def rate_of(sign: str) -> float:
    """The rate that a sign is for; 0 if it is none."""
    text = sign.rpartition("/")[2]
    return float(text) if text.isdecimal() else 0.0


def decode_sample(payload: bytes) -> StreamSample:
    """Raises Malformed."""
    if len(payload) > _MOST_MESSAGE_BYTES:
        raise Malformed(f"{len(payload)} bytes are more than any message may have ({_MOST_MESSAGE_BYTES})")
    try:
        sample = _decoder.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError, MemoryError) as bad:
        raise unread(payload, bad) from None
    if sample.v != PROTOCOL:
        raise OtherVersion(sample.v)
    return sample
