"""What a row of the table of faults says."""

from enum import Enum
from typing import Final, Literal, NamedTuple

import msgspec

from trade.errors import BusGone, DeviceError, DeviceSilent
from trade_hil_sim import Command, Heal

__all__ = ["STRUCK", "Dashboard", "Device", "Order", "Process", "Recovery", "Row", "Sick", "Stop"]

Device = Literal["dynamixel", "cia402", "robotiq", "feetech", "odrive", "damiao", "ur"]
STRUCK: Final = {
    "dynamixel": (1,),
    "cia402": (1,),
    "robotiq": (9,),
    "feetech": (1,),
    "odrive": (1,),
    "damiao": (1,),
    "ur": (),
}
"""The ids of the devices that are struck."""


_SILENT, _GONE = "degraded: silent", "degraded: bus gone"


class Sick(msgspec.Struct, frozen=True, tag_field="do", tag="sick"):
    """The driver's own process says that it is not healthy: no fault of the simulator."""

    on: bool = True


class Process(msgspec.Struct, frozen=True, tag_field="do", tag="process"):
    """The process of the driver that commands an arm is sent a signal: no fault of the simulator either."""

    signal: Literal["KILL", "STOP"]


class Dashboard(msgspec.Struct, frozen=True, tag_field="do", tag="dashboard"):
    """Another client sends a line to the dashboard of an arm's controller."""

    line: str


Order = Command | Sick | Process | Dashboard


class Stop(Enum):
    """What ends the motion that was under way."""

    NOTHING = "it does not stop: the move ends normally"
    HOLD = "the driver makes it hold"
    WATCHDOG = "the device's watchdog"
    BOTH = "the driver makes it hold and falls silent; then the device's watchdog"
    ITSELF = "the device itself"
    HOLD_OR_PROGRAM = "the driver makes it hold, gets no answer, and then makes the controller end the program"
    PROGRAM = (
        "the driver makes the controller end the program, through the dashboard; otherwise the controller's watchdog"
    )
    BLOCKED = "the obstacle; the driver makes it hold, or its overload protection releases it, whichever is first"
    UNTOLD = (
        "the driver sends nothing, as a hold could switch torque on; the joint ends at its last goal, never far ahead"
    )
    NEAR = "nothing can reach it, and it has no watchdog; it ends at its last goal, never far ahead"
    GOAL = "nothing can reach it, and it has no watchdog; it completes its last move"


class Recovery(Enum):
    """What a person has to do, once the cause is gone, before it moves again."""

    NOTHING = "nothing"
    ENABLE = "`enable()`"
    ACTIVATE = "`activate()`"
    UNLOCK = "`unlock_protective_stop()`"
    START = "`power_on()`, `release_brakes()`"


class Row(NamedTuple):
    """One fault that strikes one kind of device in the middle of a slow move."""

    device: Device
    fault: str
    strike: tuple[Order, ...]
    error: type[DeviceError] | None
    """What the move ends with; None: it goes unnoticed."""
    says: str = ""
    """Part of its message."""
    state: type[DeviceError] | str = ""
    """What ``state()`` raises while it lasts, or part of the fault it reports."""
    stop: Stop = Stop.HOLD
    stop_error: type[DeviceError] | None = None
    """What ``stop()`` raises while it lasts."""
    recovery: Recovery = Recovery.ENABLE
    then: tuple[Order, ...] = ()
    """What happens once it has been noticed."""
    found: str = ""
    """The fault that is latched then."""
    cure: tuple[Order, ...] = (Heal(),)
    bus_health: str = "healthy"
    """What its bus says in the registry while it lasts, of itself and of all its devices."""
    refuses: bool = True
    """Further moves end in an error as long as it lasts; False: it is over at once."""

    @property
    def registry(self) -> str:
        """Part of its own health in the registry while it lasts."""
        if self.bus_health != "healthy":
            return self.bus_health
        if isinstance(self.state, str):
            return self.state or "healthy"
        return {DeviceSilent: f"{_SILENT}, or {_GONE}", BusGone: _GONE}.get(self.state, "degraded: ")

    @property
    def name(self) -> str:
        """For the test's id."""
        return f"{self.device}: {self.fault}"
