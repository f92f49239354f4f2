"""Dispatch of received frames to listeners, on the thread that owns the port."""

import time
from collections.abc import Callable
from typing import Final

from trade_drivers.bus.can._port import CanPort

_SLICE_S: Final = 0.004
"""The longest wait for a frame before stops are served."""


class Listeners:
    """One CAN bus and its listeners by identifier."""

    def __init__(self, port: CanPort, between: Callable[[], None], meanwhile: Callable[[], None]) -> None:
        self.port = port
        self._between = between
        """Called between frames; may send, but not wait."""
        self._meanwhile = meanwhile
        """Called between frames if there is time left."""
        self._listeners: dict[int, Callable[[bytes], None]] = {}
        self._heard_at = 0.0

    def heard_until(self, moment: float) -> bool:
        """Returns whether all frames received by this time (``time.monotonic()``) have been processed."""
        return self._heard_at > moment

    def hear(self, can_id: int, listener: Callable[[bytes], None]) -> None:
        """Subscribes a listener to an identifier."""
        self._listeners[can_id] = listener

    def take_in(self, seconds: float, enough: Callable[[], bool] = lambda: False) -> None:
        """Processes frames for a time, or until ``enough`` returns True; 0 processes those already received.

        Raises:
            PortLost: the bus is gone.
        """
        until = time.monotonic() + seconds
        while True:
            self._between()
            if enough():
                return
            now = time.monotonic()
            if now < until:
                self._meanwhile()
            frame = self.port.receive(max(0.0, min(until - now, _SLICE_S)))
            if frame is None:
                self._heard_at = now
                if now >= until:
                    return
            elif (listener := self._listeners.get(frame.id)) is not None:
                listener(frame.data)
