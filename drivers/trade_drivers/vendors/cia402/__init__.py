"""CiA 402 drives on a CAN bus, in profile position mode."""

from trade_drivers.vendors.cia402._driver import Cia402Driver

__all__ = ["Cia402Driver"]
