"""ROBOTIS Dynamixel X-series servos, protocol 2.0, in position control."""

from trade_drivers.vendors.dynamixel._driver import DynamixelDriver

__all__ = ["DynamixelDriver"]
