"""One sample of a stream: as it travels, and as a listener is given it."""

from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Raw, Struct

from trade._wire import MOST_BYTES, PROTOCOL, Malformed, ServiceKey, why_malformed

__all__ = ["STREAMS", "Sample", "StreamSample", "decode_sample", "stream_key"]

STREAMS: Final = "stream/**"
_MOST_MESSAGE_BYTES: Final = MOST_BYTES + (1 << 20)


class Sample(Struct, frozen=True, kw_only=True):
    """What a service answered at a moment."""

    value: Any
    at: float
    """``time.time()`` of the source, when it was asked."""
    at_ns: int
    """``time.monotonic_ns()`` of the source at that moment: for intervals between samples of one stream."""
    number: int
    """Of the samples that the source has put, counted from 1; a listener with a lower rate leaves some out."""
    dropped: int = 0
    """How many that were wanted are missing since the one before: not taken in time, or lost on the way. Whether they
    would have met the listener's condition nobody knows."""


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


def stream_key(service: ServiceKey) -> str:
    """Where the samples of a service are put."""
    return f"stream/{service.domain}/{service.address}/{service.provider}/{service.name}"


def decode_sample(payload: bytes) -> StreamSample:
    """Raises Malformed."""
    if len(payload) > _MOST_MESSAGE_BYTES:
        raise Malformed(f"{len(payload)} bytes are more than any message may have ({_MOST_MESSAGE_BYTES})")
    try:
        sample = _decoder.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError, MemoryError) as bad:
        raise Malformed(why_malformed(payload, bad)) from None
    if sample.v != PROTOCOL:
        raise Malformed(why_malformed(payload, None))
    return sample
