"""Histograms of a run, one below the other on the same edges, so that their tails can be compared by eye.

All bins are equally wide, however far apart their edges. Bars grow with the logarithm of their count: one cycle of
thousands is to be seen, as it is the one that matters.
"""

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import Final

from tests.bench._ink import FONT, GRID, LEFT, OTHER, OURS, TEXT, WIDTH
from tests.bench._record import Histogram, Point

_TOP: Final = 40
_HIGH: Final = 26
"""Of the highest bar,"""
_ROW: Final = 34
"""and of its row."""
_FOOT: Final = 30
_MARGIN: Final = 24
_DECADE: Final = 10.0


def histograms(case: str, points: Sequence[Point]) -> tuple[str, int]:
    """One chart and its height: a row for each point that has a histogram, all of them with the edges of the first."""
    rows = [(point.name, point.histogram) for point in points if point.histogram is not None]
    bottom = _TOP + _ROW * len(rows)
    title = f"<text x='12' y='20' {FONT} font-size='14' font-weight='600' fill='{TEXT}'>{escape(case)}, us</text>"
    drawn = [title, *_axis(rows[0][1], bottom)]
    for row, (name, histogram) in enumerate(rows, 1):
        y = _TOP + _ROW * row - 4
        label = f"<text x='{LEFT - 12}' y='{y - 6}' {FONT} font-size='12' fill='{TEXT}' text-anchor='end'>"
        drawn += [f"{label}{escape(name)}</text>", *_bars(histogram, y)]
    return "\n".join(drawn), bottom + _FOOT


def _axis(histogram: Histogram, bottom: int) -> Iterator[str]:
    """A line at each edge that is a power of ten."""
    for number, edge in enumerate(histogram.edges, 1):
        if not math.log10(abs(edge) or _DECADE).is_integer():
            continue
        x = LEFT + number * _bin_width(histogram)
        yield f"<path d='M{x:.1f} {_TOP}V{bottom}' stroke='{GRID}'/>"
        label = f"<text x='{x:.1f}' y='{bottom + 14}' {FONT} font-size='11' text-anchor='middle' fill='{OTHER}'>"
        yield f"{label}{edge:,.0f}</text>"


def _bars(histogram: Histogram, y: int) -> Iterator[str]:
    wide, most = _bin_width(histogram), math.log1p(sum(histogram.counts))
    for number, count in enumerate(histogram.counts):
        if count:
            high = _HIGH * math.log1p(count) / most
            x = LEFT + number * wide + 1
            yield f"<path d='M{x:.1f} {y}v{-high:.1f}h{wide - 2:.1f}V{y}z' fill='{OURS}'/>"


def _bin_width(histogram: Histogram) -> float:
    return (WIDTH - LEFT - _MARGIN) / len(histogram.counts)
