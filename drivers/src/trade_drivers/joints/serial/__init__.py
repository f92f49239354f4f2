"""Servos behind one serial line that are asked and answer: what drivers of every vendor have in common.

Nothing here knows a vendor's registers or packets; ``_wire`` alone needs pyserial, and comes with a vendor's wire.
"""

from trade_drivers.joints.serial._answers import Answer, BadAnswer, NoAnswer, Refused, WireError
from trade_drivers.joints.serial._asking import health_of, told, tried
from trade_drivers.joints.serial._axis import Health, ServoAxis
from trade_drivers.joints.serial._cycle import ServoExchange
from trade_drivers.joints.serial._driver import ServoDriver
from trade_drivers.joints.serial._homing import check_homing, still_homed
from trade_drivers.joints.serial._inspect import (
    again,
    check_firmware,
    check_model,
    check_ranges,
    check_rate,
    first_ping,
)

__all__ = [
    "Answer",
    "BadAnswer",
    "Health",
    "NoAnswer",
    "Refused",
    "ServoAxis",
    "ServoDriver",
    "ServoExchange",
    "WireError",
    "again",
    "check_firmware",
    "check_homing",
    "check_model",
    "check_ranges",
    "check_rate",
    "first_ping",
    "health_of",
    "still_homed",
    "told",
    "tried",
]
