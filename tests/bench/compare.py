"""What differs between two runs of the bench: ``python -m tests.bench.compare OLD.json NEW.json``.

A figure differs if its medians lie further apart than the spread of both runs together: the ranges of the middle half
of the rounds, added. Of anything else nothing is said to be different. Runs of two machines, or of a machine at two
busy hours, differ in nearly all figures; ratios to a peer of the same round ("/ bare") differ least by themselves.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from msgspec import Struct

from tests.bench._record import Run, Spread

_FEWEST_ROUNDS: Final = 3
"""With fewer there is no spread that says anything."""


class Figure(Struct, frozen=True):
    """One figure that both runs have."""

    name: str
    old: Spread
    new: Spread

    @property
    def ratio(self) -> float:
        return self.new.median / self.old.median if self.old.median else float("nan")

    @property
    def differs(self) -> bool:
        return (
            min(self.old.rounds, self.new.rounds) >= _FEWEST_ROUNDS
            and abs(self.new.median - self.old.median) > self.old.width + self.new.width
        )


def figures(old: Run, new: Run) -> list[Figure]:
    """Those that both have, in the order of the new one."""
    before = dict(_all(old))
    return [Figure(name, before[name], spread) for name, spread in _all(new) if name in before]


def _all(run: Run) -> Iterator[tuple[str, Spread]]:
    for point in run.points:
        for what, spread in point.values.items():
            yield f"{point.part}: {point.case}: {point.name}: {what}", spread
    for target in run.targets:
        yield f"{target.part}: target {target.name}", target.measured


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.compare", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    options = parser.parse_args()
    old, new = Run.read(options.old), Run.read(options.new)
    for name, run in (("old", old), ("new", new)):
        print(f"{name}: {run.began}, commit {run.commit or 'unknown'}, {run.machine.processor}, {_others(run)}")
    if old.machine != new.machine:
        print("the machines, or their systems, are not the same: only ratios can be compared, if anything")
    elif not (old.quiet and new.quiet):
        print("other programs ran meanwhile: what differs may be their doing; look at the ratios (/ bare) first")
    found = figures(old, new)
    if not found:
        sys.exit("the two runs have no figure in common")
    print(f"\n{'':76}{'old':>11}{'new':>11}{'new / old':>11}")
    for one in found:
        word = "differs" if one.differs else ""
        print(f"{one.name:76}{one.old.median:11.4g}{one.new.median:11.4g}{one.ratio:11.2f}  {word}".rstrip())
    print(f"\n{sum(one.differs for one in found)} of {len(found)} figures differ by more than the spread of both")
    for name, run, other in (("old", old, new), ("new", new, old)):
        if lacking := len(dict(_all(run)).keys() - dict(_all(other)).keys()):
            print(f"figures in the {name} run only: {lacking}")
    _print_targets(old, new)


def _print_targets(old: Run, new: Run) -> None:
    was_met = {(one.part, one.name): one.met for one in old.targets}
    for one in new.targets:
        if was_met.get((one.part, one.name), one.met) is not one.met:
            print(f"{one.part}: target {one.name}: {'met' if one.met else 'missed'} now")


def _others(run: Run) -> str:
    return f"others took {run.others_cores:g} cores" if run.others_cores is not None else "not ended"


if __name__ == "__main__":
    main()
