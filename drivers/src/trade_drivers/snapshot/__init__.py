"""Network cameras that hand out their newest picture over HTTP: the driver ``snapshot``."""

from trade_drivers.snapshot._driver import SnapshotDriver

__all__ = ["SnapshotDriver"]
