"""Stories of robots on virtual time under drawn troubles: ``make explore SEEDS=500``, or one again: ``SEED=17``."""

import argparse
import sys
import time
from collections.abc import Sequence

from tests.endurance.explore._story import play
from tests.system.siege_minimised import fewest


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="make explore", description=__doc__)
    parser.add_argument("--seeds", type=int, default=50, help="how many stories to play")
    parser.add_argument("--first", type=int, default=1, help="the seed of the first one")
    parser.add_argument("--only", help="the numbers of the troubles to keep, such as 0,2")
    parser.add_argument("--quiet", action="store_true", help="print only what was wrong, and the sum")
    asked = parser.parse_args(words)
    only = None if asked.only is None else [int(number) for number in asked.only.split(",") if number]
    began, virtual_s, wrong = time.monotonic(), 0.0, 0
    for seed in range(asked.first, asked.first + asked.seeds):
        outcome = play(seed, only)
        virtual_s += outcome.elapsed_s
        if outcome.violations:
            wrong += 1
            print(outcome, *outcome.violations, sep="\n  ")
            fewest_of_them = _fewest(seed, outcome.troubles)
            print(f"  the fewest troubles: make explore SEEDS=1 ARGS='--first {seed} --only {fewest_of_them}'")
        elif not asked.quiet:
            print(outcome, flush=True)
    print(f"{asked.seeds} stories, {virtual_s / 3600:.3f} virtual hours, {wrong} with a violation")
    print(f"{time.monotonic() - began:.0f} s", file=sys.stderr)
    return int(wrong > 0)


def _fewest(seed: int, troubles: Sequence[str]) -> str:
    numbers = [trouble.split()[0] for trouble in troubles]
    return ",".join(fewest(numbers, lambda some: bool(play(seed, [int(number) for number in some]).violations)))


if __name__ == "__main__":
    sys.exit(main())
