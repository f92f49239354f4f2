"""Federation: `Border` offers chosen groups of each of two systems in the other; ``trade gateway`` uses it."""

from trade.sharing._border import SHARED_FROM, Border

__all__ = ["SHARED_FROM", "Border"]
