"""What an answer is and what can go wrong on the wire: all that is known of packets outside of a vendor's wire."""

from typing import NamedTuple

from trade_drivers.bus._jobs import NoAnswer, Refused, WireError

__all__ = ["Answer", "BadAnswer", "NoAnswer", "Refused", "WireError"]


class Answer(NamedTuple):
    """A status packet's contents."""

    data: bytes
    alert: bool
    """The device has something to complain of; its health says what."""


class BadAnswer(NoAnswer):
    """Something came, but it was damaged or cut short."""
