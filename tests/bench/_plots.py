"""The plots of a run: dots on a logarithmic scale, drawn as SVG by hand, so that a page needs nothing from elsewhere.

A dot is the median over the rounds, the line through it the middle half of them, a ring the p99 where there is one.
Points that have histograms are drawn as those instead.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from itertools import groupby
from typing import Final

from tests.bench._histograms import histograms
from tests.bench._ink import BARE, FONT, FOOT, GRID, LEFT, OTHER, OURS, RIGHT, ROW, TEXT, TOP, WIDTH
from tests.bench._record import Point, Run, Spread

_RINGS: Final = {"p50, us": "p99, us", "call p50, ms": "call p99, ms"}
"""What is shown by a ring beside what is shown by a dot."""
_STEPS: Final = ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8))
_FEWEST_TICKS: Final = 3
PICTURES: Final = {
    "calls": "calls",
    "in-flight": "in-flight",
    "checks": "checks",
    "gateway": "gateways",
    "jitter": "jitter",
}
"""Parts of which the documentation has a picture, and its name."""

_PAGE: Final = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; color: {text}; background: white; margin: 2rem auto; max-width: 800px }}
table {{ border-collapse: collapse }} td, th {{ padding: .15rem .8rem .15rem 0; text-align: left }}
.missed {{ color: #a8230f; font-weight: 600 }} svg {{ display: block; max-width: 100%; height: auto }}
</style>
<h1>{title}</h1>
<p>{about}</p>
<h2>Targets: {met} met, {missed} missed</h2>
<table><tr><th>part<th>target<th>asked<th>measured<th></tr>
{targets}
</table>
{plots}
</html>
"""


def figure(value: float) -> str:
    """Three digits, as people write them."""
    if value >= 1e11:
        return "never"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def with_spread(spread: Spread) -> str:
    """The median, and the middle half of the rounds."""
    if spread.rounds == 1:
        return figure(spread.median)
    return f"{figure(spread.median)} ({figure(spread.low)}-{figure(spread.high)})"


def about(run: Run) -> str:
    """One sentence on where and when, and one on who else was there."""
    machine = run.machine
    cores = "1 core" if machine.cores == 1 else f"{machine.cores} cores"
    where = f"{machine.processor}, {cores}, {machine.memory_gib:g} GiB, {machine.system}, {machine.python}"
    others = "an unknown part" if run.others_cores is None else f"{run.others_cores:g} cores"
    quiet = "The machine was quiet" if run.quiet else "The machine was **not quiet**"
    loads = f"load average {run.load_before:g} before, {run.load_after or 0:g} after"
    commit = run.commit or "unknown"
    return f"{run.began}, commit {commit}; {where}. {quiet}: other programs took {others} of it ({loads})."


def page(run: Run) -> str:
    """All of it, as one page of HTML."""
    rows = (
        f"<tr><td>{escape(one.part)}<td>{escape(one.name)}<td>{escape(one.asked)}<td>{with_spread(one.measured)}"
        f"<td{'' if one.met else ' class=missed'}>{'met' if one.met else 'missed'}</tr>"
        for one in run.targets
    )
    drawn = ((part, _drawn(part, cases)) for part, cases in _parts(run))
    plots = (f"<h2>{escape(part)}</h2>\n{svg}" for part, svg in drawn if svg)
    return _PAGE.format(
        title="Speed of TRADE",
        text=TEXT,
        about=escape(about(run)).replace("**", ""),
        met=len(run.targets) - len(run.missed),
        missed=len(run.missed),
        targets="\n".join(rows),
        plots="\n".join(plots),
    )


def pictures(run: Run) -> dict[str, str]:
    """SVG by name, of the parts that the documentation shows."""
    drawn = {PICTURES[part]: _drawn(part, cases) for part, cases in _parts(run) if part in PICTURES}
    return {name: svg for name, svg in drawn.items() if svg}


def _parts(run: Run) -> Iterator[tuple[str, dict[str, list[Point]]]]:
    for part, points in groupby(run.points, lambda one: one.part):
        cases: dict[str, list[Point]] = {}
        for point in points:
            cases.setdefault(point.case, []).append(point)
        yield part, cases


def _drawn(part: str, cases: Mapping[str, Sequence[Point]]) -> str:
    """One chart below the other; empty where there is nothing to compare."""
    charts: list[str] = []
    y = 0
    for case, points in cases.items():
        for chart, high in _charts(case, points):
            charts.append(f"<g transform='translate(0 {y})'>{chart}</g>")
            y += high
    if not charts:
        return ""
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {y}' width='{WIDTH}' height='{y}' "
        f"role='img' aria-label='{escape(part)}'>\n<rect width='100%' height='100%' fill='white'/>\n"
        + "\n".join(charts)
        + "\n</svg>\n"
    )


def _charts(case: str, points: Sequence[Point]) -> Iterator[tuple[str, int]]:
    """Each with its height."""
    if distributed := [point for point in points if point.histogram is not None]:
        yield histograms(case, distributed)
    for what, those in _by_figure([point for point in points if point.histogram is None]):
        yield _chart(case, what, those), TOP + ROW * len(those) + FOOT


def _by_figure(points: Sequence[Point]) -> Iterator[tuple[str, list[Point]]]:
    """Points that have the same first figure stand on one scale; one alone needs none."""
    firsts: dict[str, list[Point]] = {}
    for point in points:
        firsts.setdefault(next(iter(point.values)), []).append(point)
    return ((what, those) for what, those in firsts.items() if len(those) > 1)


def _chart(case: str, what: str, points: Sequence[Point]) -> str:
    ring = _RINGS.get(what, "")
    scale = _Scale([spread for point in points for name, spread in point.values.items() if name in (what, ring)])
    bottom = TOP + ROW * len(points)
    drawn = [f"<text x='12' y='20' {FONT} font-size='14' font-weight='600' fill='{TEXT}'>{escape(case)}: {what}</text>"]
    for tick in scale.ticks():
        x = scale.x(tick)
        drawn.append(f"<path d='M{x:.1f} {TOP - 10}V{bottom}' stroke='{GRID}'/>")
        label = f"<text x='{x:.1f}' y='{bottom + 14}' {FONT} font-size='11' text-anchor='middle' fill='{OTHER}'>"
        drawn.append(f"{label}{figure(tick)}</text>")
    for row, point in enumerate(points):
        drawn.append(_row(point, what, ring, scale, TOP + ROW * row + 4))
    return "\n".join(drawn)


def _row(point: Point, what: str, ring: str, scale: "_Scale", y: float) -> str:
    spread, colour = point.values[what], _colour(point.name)
    weight = 600 if colour == OURS else 400
    x, low, high = (scale.x(value) for value in (spread.median, spread.low, spread.high))
    text = f"{FONT} font-size='12' fill='{TEXT}' font-weight='{weight}'"
    drawn = [
        f"<text x='{LEFT - 12}' y='{y + 4}' {text} text-anchor='end'>{escape(point.name)}</text>",
        f"<path d='M{low:.1f} {y}H{high:.1f}' stroke='{colour}' stroke-width='4' stroke-opacity='.35'/>",
        f"<circle cx='{x:.1f}' cy='{y}' r='4.5' fill='{colour}'/>",
        f"<text x='{WIDTH - 12}' y='{y + 4}' {text} text-anchor='end'>{figure(spread.median)}</text>",
    ]
    if ring in point.values:
        far = scale.x(point.values[ring].median)
        drawn.append(f"<circle cx='{far:.1f}' cy='{y}' r='3.5' fill='none' stroke='{colour}' stroke-width='1.5'/>")
    return "".join(drawn)


def _colour(name: str) -> str:
    if name.startswith(("TRADE", "driver", "strict")):
        return OURS
    return BARE if "bare" in name else OTHER


class _Scale:
    """Logarithmic; zero and what never came stand at the ends."""

    def __init__(self, spreads: Sequence[Spread]) -> None:
        shown = [x for one in spreads for x in (one.low, one.median, one.high) if 0 < x < 1e11] or [1.0]
        self._low, self._high = math.log10(min(shown)) - 0.08, math.log10(max(shown)) + 0.08

    def x(self, value: float) -> float:
        place = math.log10(max(value, 1e-12)) - self._low
        share = min(1.0, max(0.0, place / (self._high - self._low)))
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def ticks(self) -> list[float]:
        """Powers of ten; closer where there would be fewer than three."""
        ticks: list[float] = []
        for steps in _STEPS:
            decades = range(math.floor(self._low), math.ceil(self._high) + 1)
            all_of_them = (step * 10.0**decade for decade in decades for step in steps)
            ticks = [tick for tick in all_of_them if self._low <= math.log10(tick) <= self._high]
            if len(ticks) >= _FEWEST_TICKS:
                break
        return ticks
