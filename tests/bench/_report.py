"""How a target is printed: the median, the spread, and whether it is met."""

from collections.abc import Callable, Sequence
from statistics import median


def print_target(what: str, values: Sequence[float], target: str, met: Callable[[float], bool]) -> None:
    """One line. Nothing is asserted: a figure belongs to a machine and an hour."""
    word = "met" if met(median(values)) else "missed"
    print(f"{what:32} {median(values):5.2f} ({min(values):.2f}-{max(values):.2f})  target {target:13} {word}")
