"""Feetech STS servos, on a protocol of our own over pyserial, in position control."""

from trade_drivers.vendors.feetech._driver import FeetechDriver

__all__ = ["FeetechDriver"]
