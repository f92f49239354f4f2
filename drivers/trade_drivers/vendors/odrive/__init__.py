"""ODrive motor controllers on a CAN bus (CANSimple), in position control with trapezoidal trajectories."""

from trade_drivers.vendors.odrive._driver import OdriveDriver

__all__ = ["OdriveDriver"]
