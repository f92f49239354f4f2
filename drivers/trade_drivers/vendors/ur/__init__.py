"""Arms of Universal Robots, through ur-rtde."""

from trade_drivers.vendors.ur._dashboard import SERVICES, lacking, remedy
from trade_drivers.vendors.ur._driver import UrDriver, identify

__all__ = ["SERVICES", "UrDriver", "identify", "lacking", "remedy"]
