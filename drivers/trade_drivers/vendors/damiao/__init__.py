"""Damiao motors on a CAN bus, in position-velocity mode."""

from trade_drivers.vendors.damiao._driver import DamiaoDriver

__all__ = ["DamiaoDriver"]
