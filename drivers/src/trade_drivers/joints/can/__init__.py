"""Motors with controllers of their own on a CAN bus, asked in every cycle: what those of all vendors have in common."""

from trade_drivers.joints.can._axis import Another, MotorAxis, grain_of
from trade_drivers.joints.can._driver import CanMotorDriver, axes_of

__all__ = ["Another", "CanMotorDriver", "MotorAxis", "axes_of", "grain_of"]
