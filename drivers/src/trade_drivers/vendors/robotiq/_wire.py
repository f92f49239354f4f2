"""What can go wrong on the wire: all that the rest of this folder knows of the library."""

from trade_drivers.bus._jobs import NoAnswer, WireError

__all__ = ["NoAnswer", "Refused", "WireError"]


class Refused(WireError):
    """The device answered with an exception, which a 2F-85 never does."""

    def __init__(self, device_id: int, code: int) -> None:
        super().__init__(f"id {device_id} answered with exception {code}, which a 2F-85 never does")
        self.device_id = device_id
