"""The send queue of a CAN interface when it is full: how long a sender waits for room, and why there is none."""

import time
from contextlib import suppress
from errno import ENOBUFS
from typing import Final

import can

from trade_drivers.bus._jobs import PortFull
from trade_drivers.bus.can._errors import ErrorState
from trade_drivers.bus.can._netlink import look_at

LONGEST_S: Final = 0.04
"""The longest wait for room. A bus thread has to be free for a stop within 50 ms (S07)."""
_AGAIN_S: Final = 0.0002
"""The pause between two attempts; a frame of 8 bytes takes 0.13 ms at 1 Mbit/s."""
_ENOUGH: Final = 128


def is_full(error: Exception) -> bool:
    """Returns whether an error of python-can says that the send queue is full."""
    if not isinstance(error, can.CanOperationError):
        return False
    return error.error_code == ENOBUFS or (error.error_code is None and "buffer full" in str(error))


class SendQueue:
    """The queue that a port sends into; its frames leave in their order.

    A stop does not overtake the frames before it: a goal that came after its stop would undo the stop.

    Args:
        interface: of python-can.
        channel: of that interface.
        patience_s: the longest wait for room, until a frame is taken at once.
    """

    def __init__(self, interface: str, channel: str, patience_s: float) -> None:
        self._system = interface == "socketcan"
        self._channel = channel
        self._patience_s = min(patience_s, LONGEST_S)
        self._until = 0.0

    def renew(self) -> None:
        """Ends the wait: a stop has a time of its own."""
        self._until = 0.0

    def await_room(self, *, unheard: bool) -> None:
        """Waits for a moment; ``unheard``: nothing has acknowledged a frame lately.

        Raises:
            PortFull: the queue has been full for too long.
        """
        now = time.monotonic()
        self._until = self._until or now + self._patience_s
        if now >= self._until:
            raise self.full(unheard=unheard)
        time.sleep(_AGAIN_S)

    def full(self, *, unheard: bool) -> PortFull:
        """Returns the error that names the queue, the state of the bus, and what to do."""
        queue, state = "its send queue", None
        if self._system:
            with suppress(OSError):
                link = look_at(self._channel)
                state, queue = link.state, f"the send queue of {self._channel} (txqueuelen {link.queue})"
        text = f"{queue} has been full for {self._patience_s * 1e3:.0f} ms"
        if state is not None:
            text += f"; the bus is {state.word}"
        alone = "nothing acknowledges its frames: check the power of its devices, cable, bit rate and terminations"
        if unheard or (state or ErrorState.ACTIVE) >= ErrorState.PASSIVE:
            return PortFull(f"{text}; {alone}")
        longer = f"`sudo ip link set {self._channel} txqueuelen {_ENOUGH}`, or " if self._system else ""
        return PortFull(f"{text}; it is too short: {longer}a lower rate_hz; or {alone}")
