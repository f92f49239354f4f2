"""Robotiq 2F-85 grippers on Modbus RTU."""

from trade_drivers.vendors.robotiq._driver import RobotiqDriver

__all__ = ["RobotiqDriver"]
