"""Network cameras that serve their newest picture over HTTP: the driver ``snapshot``."""

from trade_drivers.vendors.snapshot._driver import SnapshotDriver

__all__ = ["SnapshotDriver"]
