"""Arms of Universal Robots, through ur-rtde."""

from trade_drivers.vendors.ur._dashboard import SERVICES, lacking, remedy
from trade_drivers.vendors.ur._driver import UrDriver
from trade_drivers.vendors.ur._identify import identify

__all__ = ["SERVICES", "UrDriver", "identify", "lacking", "remedy"]
