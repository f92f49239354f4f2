"""A simulated CAN bus behind a send queue of limited length, as an interface of Linux has: python-can's ``queued``."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from errno import ENOBUFS
from typing import Any, ClassVar

import can
import pytest
from can.interfaces.socketcand import SocketCanDaemonBus

__all__ = ["QueuedBus"]


class QueuedBus(SocketCanDaemonBus):
    """A client of the simulated bus. Its switches hold for all clients."""

    length: ClassVar[int]
    """``txqueuelen``, in frames."""
    frame_s: ClassVar[float]
    """How long the wire takes for a frame, in seconds."""
    stuck: ClassVar[bool]
    """Nothing acknowledges a frame, so none leaves the queue."""
    error: ClassVar[int]
    """The class of the errors that the controller reports while nothing is received (linux/can/error.h); 0: none."""
    full_every: ClassVar[int]
    """Of so many frames, one finds the queue full however idle the wire is; 0: none does."""
    full_for: ClassVar[int]
    """So many attempts to send from now on find the queue full."""
    offers: ClassVar[int]
    """Frames that the queue was to take."""
    refused: ClassVar[int]
    """Frames that found the queue full."""

    @classmethod
    @contextmanager
    def offered(cls) -> Iterator[None]:
        """Lets python-can open ``queued:HOST:PORT/can0`` meanwhile."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(can.interfaces.BACKENDS, "queued", (cls.__module__, cls.__name__))
            patch.setattr("can.util.VALID_INTERFACES", {*can.VALID_INTERFACES, "queued"})
            cls.reset()
            yield

    @classmethod
    def reset(cls, length: int = 10, frame_s: float = 0.0) -> None:
        cls.length, cls.frame_s = length, frame_s
        cls.stuck, cls.error, cls.full_every, cls.full_for = False, 0, 0, 0
        cls.offers = cls.refused = 0

    def __init__(self, channel: str, **_: Any) -> None:
        address, _, name = channel.partition("/")
        host, _, port = address.partition(":")
        self._waiting: deque[can.Message] = deque()
        self._next_at = 0.0
        super().__init__(name, host, int(port), tcp_tune=True)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._drain()
        type(self).offers += 1
        full = self.full_for > 0 or (self.full_every and self.offers % self.full_every == 0)
        type(self).full_for = max(0, self.full_for - 1)
        if full or len(self._waiting) >= self.length:
            type(self).refused += 1
            raise can.CanOperationError("Failed to transmit: No buffer space available", ENOBUFS)
        self._waiting.append(msg)
        self._drain()

    def _recv_internal(self, timeout: float | None) -> Any:
        self._drain()
        message, filtered = super()._recv_internal(timeout)
        if message is None and self.error:
            message = can.Message(arbitration_id=self.error, data=bytes(8), is_error_frame=True)
        return message, filtered

    def _drain(self) -> None:
        now = time.monotonic()
        while self._waiting and not self.stuck and self._next_at <= now:
            self._next_at = max(self._next_at, now - self.frame_s) + self.frame_s
            super().send(self._waiting.popleft())
