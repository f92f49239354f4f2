"""Sizes, colours and letters of the plots."""

from typing import Final

WIDTH: Final = 760
LEFT: Final = 190
"""Where names end and figures begin."""
RIGHT: Final = 120
"""Of the right margin, for a figure."""
TOP: Final = 44
ROW: Final = 22
FOOT: Final = 34
OURS, BARE, OTHER, GRID, TEXT = "#1261c4", "#333b45", "#8a929c", "#e3e6ea", "#1c2127"
FONT: Final = "font-family='system-ui, sans-serif'"
