"""What parts of the bench say of themselves: each point and each target is printed and kept with the run."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from statistics import median

from tests.bench._record import Histogram, Point, Run, Skipped, Spread, Target

_part = ""


@cache
def this_run() -> Run:
    """The one that this process makes."""
    return Run.begin()


def begin_part(name: str) -> None:
    """What is reported from now on belongs to it."""
    global _part  # noqa: PLW0603 - a process runs one part at a time
    _part = name


def mark() -> tuple[int, int, int]:
    """How far the run is, for `forget_since`."""
    run = this_run()
    return len(run.points), len(run.targets), len(run.skipped)


def forget_since(marked: tuple[int, int, int]) -> None:
    """What was reported since then is reported once more, or not at all."""
    run = this_run()
    for reported, count in zip((run.points, run.targets, run.skipped), marked, strict=True):
        del reported[count:]


def keep_point(
    case: str, name: str, n: int, values: Mapping[str, Sequence[float]], histogram: Histogram | None = None
) -> None:
    """What was measured, a figure for each round.

    Args:
        case: under which; points of one case stand in one table.
        name: of what.
        n: calls, cycles or samples of all rounds; 0 where there is nothing to count.
        values: by what it is, with its unit.
        histogram: of all that was measured, if it is to be shown.
    """
    spreads = {what: Spread.of(figures) for what, figures in values.items()}
    this_run().points.append(Point(_part, case, name, n, spreads, histogram))


def print_target(what: str, values: Sequence[float], target: str, met: Callable[[float], bool]) -> None:
    """One line. Nothing is asserted: a figure belongs to a machine and an hour."""
    is_met = met(median(values))
    this_run().targets.append(Target(_part, what, target, Spread.of(values), is_met))
    word = "met" if is_met else "missed"
    print(f"{what:32} {median(values):5.2f} ({min(values):.2f}-{max(values):.2f})  target {target:13} {word}")


def print_skipped(what: str, reason: str) -> None:
    """What was not measured."""
    this_run().skipped.append(Skipped(_part, what, reason))
    print(f"{what}: skipped, {reason}")


def print_all_targets() -> None:
    """Those of all parts, at the end."""
    run = this_run()
    if not run.targets:
        return
    print(f"\nall targets: {len(run.targets) - len(run.missed)} met, {len(run.missed)} missed")
    for one in run.targets:
        figure = f"{one.measured.median:.4g} ({one.measured.least:.4g}-{one.measured.most:.4g})"
        print(f"{'met' if one.met else 'MISSED':7} {one.part:11} {one.name:39} {figure:28} {one.asked}")
