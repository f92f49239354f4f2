"""docs/performance.md and its pictures, from the run in docs/performance.json: ``python -m tests.bench.page``.

Nothing on that page is written by hand but what is in why.toml beside this module: the reasons for missed targets,
and the bounds that replaced some.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Final

from msgspec import Struct, convert

from tests.bench._plots import PICTURES, about, figure, pictures, with_spread
from tests.bench._record import Point, Run, Target

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_ROOT: Final = Path(__file__).parents[2]
DOCS: Final = _ROOT / "docs"
_WHY: Final = Path(__file__).with_name("why.toml")
_HIDDEN: Final = ("p99 / bare",)
"""Figures that a table has no room for; the JSON has them."""

_HEAD: Final = """# Performance

For people who choose middleware or tune a system, and for contributors.
After reading, you know the speed of TRADE next to other software and next to its targets, and the reasons for misses.

`make bench-page` generates this page from [performance.json](performance.json), a run of `make bench` on one computer.
The ratios are more general than the times. [Testing](testing.md#speed) describes how to run it, and how to compare two
runs.

## The run

{about}
It took {minutes:.0f} minutes: `{command}`. Versions: {versions}.

- A remote call goes from one process to another on this computer, over loopback. "Between hosts" means between network
  namespaces that a virtual cable connects.
- The rows of a table took turns in one run, round by round, in a changing order. A ratio ("/ bare") divides two turns
  of the same round.
- A figure is the median of the rounds, with the middle half of them in brackets. p50 and p99 are of the calls of one
  round. n is the number of calls in all rounds.
- CPU is the processor time of both ends together, for each call.
- "bare" is the bare zenoh pair: a put to the other process and a put back, without any code of TRADE.
- In the pictures, a dot is the median, the line through it the middle half of the rounds, and a ring the p99.
"""
_PARTS: Final = {
    "calls": "Remote calls, one at a time",
    "in-flight": "Remote calls, 32 in flight",
    "checks": "The cost of certificates, hooks and locks",
    "local": "Calls in the same container",
    "registry": "A container that joins many services",
    "deadman": "From the end of a client to the end of its motion",
    "locks": "Locks",
    "watching": "Notifications and hooks",
    "audit": "Audit records",
    "gateway": "Gateways",
    "streams": "Streams",
    "servo": "Dynamixel servos, 1 Mbaud",
    "feetech": "Feetech servos, 1 Mbaud",
    "can": "CiA 402 drives, 1 Mbit/s",
    "rosie": "All drivers of a robot",
    "supervisor": "The supervisor",
    "arm": "An arm",
    "jitter": "Jitter of bus loops",
}
_NOTES: Final = {
    "jitter": """The figure is the time between the first requests of two cycles minus the period, in us. A negative one
follows a late cycle. A simulator in a separate process reads the requests from the wire. The edges of the pictures'
bins are 1, 2 and 5 times powers of ten on either side of zero. Bars grow with the logarithm of their count.

"load" is one busy process for each processor. Where the operating system allows SCHED_FIFO, the simulator has it in all
cases. In cases with that name, the driver has it, too. "nothing" is a loop that only sleeps until its next turn. If a
mean is not zero, the loop did not keep its period.""",
}
"""What has to be said of a part."""


class Reason(Struct, frozen=True, forbid_unknown_fields=True):
    """Why targets are missed."""

    targets: tuple[str, ...]
    """By name."""
    why: str
    """As a profile shows."""
    tried: str


class Bound(Struct, frozen=True, forbid_unknown_fields=True):
    """A bound that was found, and that took the place of targets."""

    asked: tuple[str, ...]
    """Those targets."""
    targets: tuple[str, ...]
    """By name, the ones that replaced them."""
    why: str


class Why(Struct, frozen=True, forbid_unknown_fields=True):
    """What is written by hand."""

    reason: tuple[Reason, ...] = ()
    bound: tuple[Bound, ...] = ()

    @property
    def reasons(self) -> dict[str, Reason]:
        """By the name of each target that one is for."""
        return {name: reason for reason in self.reason for name in reason.targets}


def read_why(file: Path = _WHY) -> Why:
    """What is written by hand."""
    return convert(tomllib.loads(file.read_text()), Why)


def written(run: Run, why: Why) -> str:
    """The page."""
    head = _HEAD.format(
        about=about(run),
        minutes=(run.took_s or 0) / 60,
        command=" ".join(["python -m tests.bench", *run.arguments]),
        versions=", ".join(f"{name} {version}" for name, version in run.versions.items()),
    )
    return "\n".join([head.rstrip(), *_again(run), *_targets(run, why), *_measured(run), *_skipped(run)]) + "\n"


def _again(run: Run) -> Iterator[str]:
    for one in run.again:
        others = "an unknown part" if one.others_cores is None else f"{one.others_cores:g} cores"
        command = " ".join(["python -m tests.bench", *one.arguments])
        yield f"- **Measured again**: {', '.join(one.parts)}; {one.began}, commit {one.commit or 'unknown'}, while"
        yield f"  other programs took {others} of the machine: `{command}`."


def _targets(run: Run, why: Why) -> Iterator[str]:
    yield f"\n## Targets: {len(run.targets) - len(run.missed)} met, {len(run.missed)} missed\n"
    yield from _table(("part", "target", "asked", "measured", ""), map(_row, run.targets))
    measured = {target.name: with_spread(target.measured) for target in run.targets}
    if bounds := [bound for bound in why.bound if measured.keys() & set(bound.targets)]:
        yield "\n### Targets that a bound replaced"
    for bound in bounds:
        yield f"\n**Asked: {'; '.join(bound.asked)}. Now: {'; '.join(bound.targets)}**\n"
        yield bound.why.strip()
    if not run.missed:
        return
    reasons = why.reasons
    yield "\n### Missed, and why"
    for reason in dict.fromkeys(reasons.get(target.name) for target in run.missed):
        names = [target.name for target in run.missed if reasons.get(target.name) == reason]
        yield f"\n**{'; '.join(names)}**\n"
        yield f"{reason.why.strip()}\n\nTried: {reason.tried.strip()}" if reason else "There is no explanation yet."


def _row(target: Target) -> tuple[str, ...]:
    word = "met" if target.met else "**missed**"
    return target.part, target.name, target.asked, with_spread(target.measured), word


def _measured(run: Run) -> Iterator[str]:
    drawn = pictures(run)
    for part, points in groupby(run.points, lambda one: one.part):
        yield f"\n## {_PARTS.get(part, part)}"
        if PICTURES.get(part) in drawn:
            yield f"\n![{_PARTS[part]}](pictures/performance-{PICTURES[part]}.svg)"
        if part in _NOTES:
            yield f"\n{_NOTES[part]}"
        cases: dict[str, list[Point]] = {}
        for point in points:
            cases.setdefault(point.case, []).append(point)
        for case, those in cases.items():
            yield f"\n### {case[:1].upper()}{case[1:]}\n"
            names = [
                name for name in dict.fromkeys(name for one in those for name in one.values) if name not in _HIDDEN
            ]
            yield from _table(("", "n", *names), (_figures(one, names) for one in those))


def _figures(point: Point, names: Sequence[str]) -> tuple[str, ...]:
    shown = (with_spread(point.values[name]) if name in point.values else "" for name in names)
    return point.name, figure(point.n), *shown


def _skipped(run: Run) -> Iterator[str]:
    if run.skipped:
        yield "\n## Not measured\n"
        yield from _table(("part", "what", "reason"), ((one.part, one.name, one.reason) for one in run.skipped))


def _table(head: Sequence[str], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def files(run: Run, why: Why) -> dict[str, str]:
    """What belongs into docs/, by path."""
    drawn = {f"pictures/performance-{name}.svg": picture for name, picture in pictures(run).items()}
    return {"performance.md": written(run, why), **drawn}


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.page", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, default=DOCS / "performance.json", help="the run; default %(default)s")
    parser.add_argument("--to", type=Path, default=DOCS, help="the folder to write to; default %(default)s")
    options = parser.parse_args()
    run, why = Run.read(options.json), read_why()
    reasons = why.reasons
    for name, text in files(run, why).items():
        (options.to / name).parent.mkdir(parents=True, exist_ok=True)
        (options.to / name).write_text(text)
        print(f"wrote {options.to / name}")
    for target in run.missed:
        if target.name not in reasons:
            print(f"missed without an explanation in {_WHY.name}: {target.name}")
    explained = reasons.keys() | {name for bound in why.bound for name in bound.targets}
    for name in sorted(explained - {target.name for target in run.targets}):
        print(f"explained in {_WHY.name}, and not in this run: {name}")


if __name__ == "__main__":
    main()
