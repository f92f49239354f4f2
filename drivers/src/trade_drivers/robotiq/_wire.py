"""What can go wrong on the wire, and how long it may take: all that the rest of this folder knows of the library."""

from typing import Final

__all__ = ["DRAIN_S", "LONGEST_WAIT_S", "NoAnswer", "Refused", "WireError"]

ANSWER_MARGIN_S: Final = 0.034
"""Patience beyond the time the bytes take: twice the default 16 ms latency of an FTDI adapter, and 2 ms."""
LONGEST_WAIT_S: Final = 0.048
"""No exchange waits longer than this, so that a stop is never more than 50 ms from the wire."""
DRAIN_S: Final = 0.030
"""Silence kept after a failed exchange: an answer that is late arrives now and is thrown away, not believed later."""
LONGEST_DRAIN_S: Final = 0.120
"""From the third failure in a row on."""


class WireError(Exception):
    """An exchange failed."""


class NoAnswer(WireError):
    """Nothing came within the time that was whole and belonged to the question."""

    def __init__(self, device_id: int, waited_s: float) -> None:
        super().__init__(f"id {device_id} did not answer within {waited_s * 1e3:.0f} ms")
        self.device_id = device_id
        self.waited_s = waited_s


class Refused(WireError):
    """The device answered with an exception, which a 2F-85 never does."""

    def __init__(self, device_id: int, code: int) -> None:
        super().__init__(f"id {device_id} answered with exception {code}, which a 2F-85 never does")
        self.device_id = device_id
