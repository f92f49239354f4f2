"""What an answer is and what can go wrong on the wire: all that the rest of this folder knows of the vendor library."""

from typing import Final, NamedTuple

__all__ = ["DRAIN_S", "LONGEST_WAIT_S", "Answer", "BadAnswer", "NoAnswer", "Refused", "WireError"]

ANSWER_MARGIN_S: Final = 0.034
"""Patience beyond the time the bytes take: twice the default 16 ms latency of an FTDI adapter, and 2 ms."""
LONGEST_WAIT_S: Final = 0.048
"""No exchange waits longer than this, so that a stop is never more than 50 ms from the wire."""
DRAIN_S: Final = 0.030
"""Silence kept after a failed exchange: an answer that is late arrives now and is thrown away, not believed later."""

_NUMBERS: Final = {
    1: "could not carry it out",
    2: "does not know the instruction",
    3: "received a damaged packet",
    4: "data range: the value is out of range, or its watchdog has locked the goal registers",
    5: "data length: too few bytes for the register",
    6: "data limit: the value is outside the device's own limit register",
    7: "access: the register is read-only, or kept without power and torque is on",
}


class Answer(NamedTuple):
    """A status packet's contents."""

    data: bytes
    alert: bool
    """The device has a hardware error latched; register 70 says which."""


class WireError(Exception):
    """An exchange failed."""


class NoAnswer(WireError):
    """Nothing came within the time."""

    def __init__(self, device_id: int, waited_s: float) -> None:
        super().__init__(f"id {device_id} did not answer within {waited_s * 1e3:.0f} ms")
        self.device_id = device_id
        self.waited_s = waited_s


class BadAnswer(NoAnswer):
    """Something came, but it was damaged or cut short."""


class Refused(WireError):
    """The device answered that it would not."""

    def __init__(self, device_id: int, number: int) -> None:
        super().__init__(_NUMBERS.get(number, f"error number {number}"))
        self.device_id = device_id
        self.number = number
