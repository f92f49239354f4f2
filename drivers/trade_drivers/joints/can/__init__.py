"""The common base of drivers for motors with their own controllers on a CAN bus, polled in each cycle."""

from trade_drivers.joints.can._axis import STILL_RAD_S, Another, MotorAxis, check_zero_known, resolution_of
from trade_drivers.joints.can._driver import CanMotorDriver, axes_of

__all__ = ["STILL_RAD_S", "Another", "CanMotorDriver", "MotorAxis", "axes_of", "check_zero_known", "resolution_of"]
