"""Memory that both ends of a local connection share, because a large payload takes longer on the socket.

Each direction has one place. A sender copies a payload into its place, and the receiver copies it out before it reads
it. So the sender may change its own memory, and a receiver never sees bytes change that it has checked.
"""

import contextlib
import os
import sys
from collections.abc import Iterable, Sequence
from mmap import mmap
from typing import Final

from msgspec import Raw

from trade.protocol.messages import Malformed

_PLACE_BYTES: Final = 8 << 20
_MOST_BYTES: Final = 128 << 20
"""Of both places of another version's."""


class SharedSegment:
    """One end's view of it. Its pages take memory once they were used, until both ends have closed it.

    Args:
        memory: both places; that of the caller comes first.
        caller: whether this is the caller's end.
    """

    def __init__(self, memory: mmap, *, caller: bool) -> None:
        self._memory = memory
        self.most_bytes: Final = len(memory) // 2
        """The largest payload."""
        self._out = 0 if caller else self.most_bytes
        self._in = self.most_bytes - self._out
        self.free = not caller
        """Whether the last payload was copied out. The caller has to wait until the callee has taken the segment."""

    @staticmethod
    def make() -> "tuple[SharedSegment, int] | None":
        """A new one, and its descriptor, to pass it and to close it; None if there can be none."""
        if sys.platform != "linux":
            return None
        import fcntl  # noqa: PLC0415 - not on every system

        descriptor = -1
        try:
            descriptor = os.memfd_create("trade-calls", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.ftruncate(descriptor, 2 * _PLACE_BYTES)
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
            return SharedSegment(mmap(descriptor, 2 * _PLACE_BYTES), caller=True), descriptor
        except OSError:  # no descriptors, or no memory
            if descriptor >= 0:
                os.close(descriptor)
            return None

    @staticmethod
    def taken(descriptors: Sequence[int], size_bytes: int) -> "SharedSegment | None":
        """The callee's end; None if there is none, or if this process had no descriptor for it.

        Args:
            descriptors: what came with a greeting; they stay open.
            size_bytes: what the greeting announces; 0 for none.

        Raises:
            Malformed: it is not as announced, or could shrink, which would end the process that reads it.
        """
        if not descriptors:
            return None
        if len(descriptors) > 1 or sys.platform != "linux":
            raise Malformed(f"{len(descriptors)} descriptors came with a greeting")
        import fcntl  # noqa: PLC0415 - not on every system

        [descriptor] = descriptors
        needed = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
        try:
            sealed = fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & needed == needed
        except OSError:
            raise Malformed("what came with a greeting is no memory") from None
        size = os.fstat(descriptor).st_size
        if not sealed or size != size_bytes or size % 2 or not 0 < size <= _MOST_BYTES:
            raise Malformed(f"shared memory of {size} bytes came with a greeting, not {size_bytes} sealed ones")
        try:
            return SharedSegment(mmap(descriptor, size), caller=False)
        except OSError:
            return None

    @property
    def size_bytes(self) -> int:
        """Of both places."""
        return len(self._memory)

    def put(self, parts: Iterable[bytes | Raw]) -> None:
        """Copies the parts of a payload into the free place of this end."""
        self.free = False
        at = self._out
        for part in parts:
            self._memory[at : at + len(part)] = memoryview(part)
            at += len(part)

    def copy_to(self, place: memoryview) -> None:
        """Copies a payload of the size of ``place`` out of the other end's place."""
        with memoryview(self._memory) as memory, memory[self._in : self._in + len(place)] as payload:
            place[:] = payload

    def close(self) -> None:
        """Releases it. Idempotent."""
        with contextlib.suppress(BufferError):  # in a child that was forked while a thread copied
            self._memory.close()
