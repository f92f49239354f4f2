"""Feetech STS servos, on a protocol of our own over pyserial, in position control."""

from trade_drivers.vendors.feetech._driver import FeetechDriver, open_exchange

__all__ = ["FeetechDriver", "open_exchange"]
