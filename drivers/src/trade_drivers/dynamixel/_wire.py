"""What an answer is and what can go wrong on the wire: all that the rest of this folder knows of the vendor library."""

from typing import Final, NamedTuple

from trade_drivers._work import NoAnswer, WireError

__all__ = ["Answer", "BadAnswer", "NoAnswer", "Refused", "WireError"]

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


class BadAnswer(NoAnswer):
    """Something came, but it was damaged or cut short."""


class Refused(WireError):
    """The device answered that it would not."""

    def __init__(self, device_id: int, number: int) -> None:
        super().__init__(_NUMBERS.get(number, f"error number {number}"))
        self.device_id = device_id
        self.number = number
