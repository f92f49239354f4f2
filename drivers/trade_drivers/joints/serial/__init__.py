"""The common base of drivers for servos on a serial line with requests and answers.

It is independent of a vendor's registers and packets. Only ``_wire`` needs pyserial; a vendor's wire imports it.
"""

from trade_drivers.bus._jobs import BadAnswer, NoAnswer, RequestRefused, WireError
from trade_drivers.joints.serial._axis import Answer, Health, ServoAxis
from trade_drivers.joints.serial._commission import ServoBench
from trade_drivers.joints.serial._cycle import ServoExchange
from trade_drivers.joints.serial._driver import ServoDriver
from trade_drivers.joints.serial._inspect import (
    PersistentRegisters,
    check_cycle,
    check_own_range,
    check_ranges,
    first_look,
)

__all__ = [
    "Answer",
    "BadAnswer",
    "Health",
    "NoAnswer",
    "PersistentRegisters",
    "RequestRefused",
    "ServoAxis",
    "ServoBench",
    "ServoDriver",
    "ServoExchange",
    "WireError",
    "check_cycle",
    "check_own_range",
    "check_ranges",
    "first_look",
]
