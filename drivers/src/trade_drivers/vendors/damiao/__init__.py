"""Damiao motors on a CAN bus, in position-velocity mode."""

from trade_drivers.vendors.damiao._driver import DamiaoDriver, open_exchange

__all__ = ["DamiaoDriver", "open_exchange"]
