"""Arms of Universal Robots, through ur-rtde."""

from trade_drivers.ur._driver import UrDriver

__all__ = ["UrDriver"]
