"""The errors that only drivers raise."""

from dataclasses import dataclass

from trade.errors import CallerError, DeviceSilent

__all__ = ["BusGone", "MotionStopped"]


@dataclass(kw_only=True, eq=False)
class MotionStopped(CallerError, RuntimeError):
    """A motion ended before its goal because somebody wanted it to; the joint holds where it stopped."""

    device: str
    reason: str

    def describe(self) -> str:
        return f"{self.device} stopped before its goal: {self.reason}. It holds its position until it is moved again"


@dataclass(kw_only=True, eq=False)
class BusGone(DeviceSilent, ConnectionError):
    """The port of a bus is gone: its adapter was unplugged. It is opened again by itself when it comes back."""

    def describe(self) -> str:
        return (
            f"{self.device} cannot be reached: port {self.bus} is gone (for {self.waited_s:.1f} s); plug its adapter "
            "in again. The driver reconnects by itself and moves nothing"
        )
