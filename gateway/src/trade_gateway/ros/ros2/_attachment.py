"""What travels beside each message, request and response.

Facts, from ros2/rmw_zenoh (``rmw_zenoh_cpp/src/detail/attachment_helpers.cpp`` since its change 601 of spring 2025) and
zenoh's serialization format: sequence number and time in ns since 1970 as 64-bit little-endian integers, then the 16
bytes of the endpoint's gid with their number, one byte, before them. A response carries the sequence number and gid of
its request, and a time of its own. Sequence numbers start at 1.
"""

import struct
from typing import Final, NamedTuple

__all__ = ["GID_BYTES", "Attachment"]

GID_BYTES: Final = 16
_FORMAT: Final = struct.Struct(f"<qqB{GID_BYTES}s")


class Attachment(NamedTuple):
    """See the module."""

    sequence: int
    time_ns: int
    gid: bytes

    def to_bytes(self) -> bytes:
        """As it travels."""
        return _FORMAT.pack(self.sequence, self.time_ns, GID_BYTES, self.gid)

    @classmethod
    def from_bytes(cls, data: bytes) -> "Attachment":
        """One that came.

        Raises:
            ValueError: these are not the bytes of one, or of an older rmw_zenoh.
        """
        if len(data) != _FORMAT.size:
            raise ValueError(f"an attachment has {_FORMAT.size} bytes, not {len(data)}")
        sequence, time_ns, length, gid = _FORMAT.unpack(data)
        if length != GID_BYTES:
            raise ValueError(f"a gid has {GID_BYTES} bytes, not {length}")
        return cls(sequence, time_ns, gid)
