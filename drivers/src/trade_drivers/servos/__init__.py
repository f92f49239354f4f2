"""Servos behind one serial line that are asked and answer: what drivers of every vendor have in common.

Nothing here knows a vendor's registers or packets; ``_wire`` alone needs pyserial, and comes with a vendor's wire.
"""

from trade_drivers.servos._answers import Answer, BadAnswer, NoAnswer, Refused, WireError
from trade_drivers.servos._asking import health_of, told, tried
from trade_drivers.servos._attach import again, check_firmware, check_model, check_ranges, check_rate, first_ping
from trade_drivers.servos._axis import Health, ServoAxis
from trade_drivers.servos._driver import ServoDriver
from trade_drivers.servos._exchange import ServoExchange
from trade_drivers.servos._homing import check_homing, still_homed

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
