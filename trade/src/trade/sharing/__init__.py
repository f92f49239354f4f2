"""What two systems share: `Border` offers chosen groups of each in the other. ``trade gateway`` does it by a file."""

from trade.sharing._border import SHARED_FROM, Border

__all__ = ["SHARED_FROM", "Border"]
