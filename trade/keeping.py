"""Files that keep data beyond the life of a process, for programs that need such files."""

from trade._storage.database import Database

__all__ = ["Database"]
