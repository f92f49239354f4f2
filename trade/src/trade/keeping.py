"""Files in which something outlives its process, for whoever keeps such."""

from trade._storage.database import Database

__all__ = ["Database"]
