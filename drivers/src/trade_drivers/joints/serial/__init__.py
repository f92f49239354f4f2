"""Servos behind one serial line that are asked and answer: what drivers of every vendor have in common.

Nothing here knows a vendor's registers or packets; ``_wire`` alone needs pyserial, and comes with a vendor's wire.
"""

from trade_drivers.bus._jobs import BadAnswer, NoAnswer, Refused, WireError
from trade_drivers.joints.serial._asking import health_of, still_homed, told, tried
from trade_drivers.joints.serial._axis import Answer, Health, ServoAxis
from trade_drivers.joints.serial._cycle import ServoExchange
from trade_drivers.joints.serial._driver import ServoDriver
from trade_drivers.joints.serial._inspect import Kept, check_cycle, check_own_range, check_ranges, first_look

__all__ = [
    "Answer",
    "BadAnswer",
    "Health",
    "Kept",
    "NoAnswer",
    "Refused",
    "ServoAxis",
    "ServoDriver",
    "ServoExchange",
    "WireError",
    "check_cycle",
    "check_own_range",
    "check_ranges",
    "first_look",
    "health_of",
    "still_homed",
    "told",
    "tried",
]
