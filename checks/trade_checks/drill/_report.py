"""The results of a drill, as records and as a page: for each scene, how long each joint moved and may move."""

from html import escape
from typing import Any, Final, Literal

import msgspec
from msgspec import Struct

Verdict = Literal["ok", "too long", "moved again", "did not stop"]


class Stop(Struct, frozen=True, kw_only=True):
    """How a joint came to rest in a scene."""

    joint: str
    bus: str
    took_s: float | None
    """Time from the failure until the final rest, in seconds; None: it still moved after the longest wait."""
    limit_s: float
    again_s: float | None = None
    """Time of an unrequested motion after the recovery, in seconds from the failure; None: there was none."""

    @property
    def verdict(self) -> Verdict:
        """The verdict on this stop."""
        if self.took_s is None:
            return "did not stop"
        if self.again_s is not None:
            return "moved again"
        return "ok" if self.took_s <= self.limit_s else "too long"

    @property
    def part(self) -> float:
        """The used fraction of its limit; infinite if it did not stop."""
        return float("inf") if self.took_s is None else self.took_s / self.limit_s


class SceneReport(Struct, frozen=True, kw_only=True):
    """The results of one scene."""

    scene: str
    what: str
    shows: str
    stops: list[Stop] = []
    problems: list[str] = []
    """Why attempts were invalid; the last one was valid if there are stops."""

    @property
    def ok(self) -> bool:
        """Whether it ran, and each joint kept its limit."""
        return bool(self.stops) and all(stop.verdict == "ok" for stop in self.stops)


class Report(Struct, frozen=True, kw_only=True):
    """The results of a whole drill."""

    robot: str
    file: str
    version: str
    host: str
    at: str
    """Date and time, ISO 8601."""
    scenes: list[SceneReport]
    left_out: dict[str, str]
    """Parts of the robot and scenes that were skipped, and why."""

    @property
    def ok(self) -> bool:
        """Whether there was a scene, and all of them are ok."""
        return bool(self.scenes) and all(played.ok for played in self.scenes)


def as_data(report: Report) -> dict[str, Any]:
    """The report as plain data, with the verdicts."""
    data: dict[str, Any] = msgspec.to_builtins(report)
    for played, scene in zip(report.scenes, data["scenes"], strict=True):
        scene["ok"] = played.ok
        for stop, row in zip(played.stops, scene["stops"], strict=True):
            row["verdict"] = stop.verdict
    return {"ok": report.ok, **data}


_LIMIT_PERCENT: Final = 70.0
"""Position of the limit in a bar."""

_STYLE: Final = """
:root { color-scheme: light dark; --ok: #2e7d32; --bad: #c62828; --line: #8886; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 56rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0; }
.ok { color: var(--ok); } .bad { color: var(--bad); }
section { border-top: 1px solid var(--line); padding: .5rem 0; break-inside: avoid; }
table { border-collapse: collapse; width: 100%; }
td, th { text-align: left; padding: .15rem .75rem .15rem 0; font-weight: normal; white-space: nowrap; }
td.bar { width: 50%; }
.bar div { position: relative; height: .8rem; background: #8883; print-color-adjust: exact; }
.bar i { position: absolute; inset: 0 auto 0 0; background: var(--ok); print-color-adjust: exact; }
.bar i.over { background: var(--bad); }
.bar b { position: absolute; top: -.15rem; bottom: -.15rem; border-left: 2px solid currentColor; }
@media (prefers-color-scheme: dark) { :root { --ok: #81c784; --bad: #ef9a9a; } }
"""


def page(report: Report) -> str:
    """Returns the page: the worst results come first."""
    verdict = '<strong class="ok">passed</strong>' if report.ok else '<strong class="bad">failed</strong>'
    facts = f"{escape(report.file)}, TRADE {escape(report.version)}, on {escape(report.host)}, {escape(report.at)}"
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>Drill of {escape(report.robot)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>Drill of {escape(report.robot)}: {verdict}</h1><p>{facts}</p>",
        "<p>The devices were simulated. By their log, each time is from the failure until the joint was at rest.",
        "The mark in a bar is the limit. This measurement is not safety-rated.</p>",
        *(_scene(played) for played in sorted(report.scenes, key=_severity)),
        _left_out(report),
        "</body></html>",
    ]
    return "\n".join(part for part in parts if part) + "\n"


def _severity(played: SceneReport) -> tuple[bool, float]:
    return played.ok, -max((stop.part for stop in played.stops), default=0.0)


def _scene(played: SceneReport) -> str:
    colour, word = ("ok", "ok") if played.ok else ("bad", "failed")
    head = f'<h2>{escape(played.scene)} <small class="{colour}">{word}</small></h2>'
    what = f"<p>{escape(played.what)} (shows {escape(played.shows)} of docs/safety.md)</p>"
    what += "".join(f"<p>not run: {escape(problem)}</p>" for problem in played.problems)
    if not played.stops:
        return f"<section>{head}{what}</section>"
    rows = "".join(map(_row, sorted(played.stops, key=lambda stop: -stop.part)))
    columns = "<tr><th>joint</th><th>bus</th><th>moved for</th><th>limit</th><th></th><th></th></tr>"
    return f"<section>{head}{what}<table>{columns}{rows}</table></section>"


def _row(stop: Stop) -> str:
    took = "-" if stop.took_s is None else f"{stop.took_s:.3f} s"
    colour = "ok" if stop.verdict == "ok" else "bad"
    again = f", {stop.again_s:.3f} s after the failure" if stop.again_s is not None else ""
    width = min(100.0, stop.part * _LIMIT_PERCENT)
    over = ' class="over"' if stop.part > 1 else ""
    bar = f'<div><i{over} style="width: {width:.1f}%"></i><b style="left: {_LIMIT_PERCENT:.1f}%"></b></div>'
    cells = f"<td>{escape(stop.joint)}</td><td>{escape(stop.bus)}</td><td>{took}</td><td>{stop.limit_s:.3f} s</td>"
    return f'<tr>{cells}<td class="bar">{bar}</td><td class="{colour}">{stop.verdict}{again}</td></tr>'


def _left_out(report: Report) -> str:
    if not report.left_out:
        return ""
    items = "".join(f"<li>{escape(part)}: {escape(why)}</li>" for part, why in report.left_out.items())
    return f"<section><h2>Left out</h2><ul>{items}</ul></section>"
