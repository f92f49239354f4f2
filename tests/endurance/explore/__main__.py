"""Stories of robots on virtual time under drawn troubles: ``make explore SEEDS=500``, or one again: ``--first 17``.

The exit code is 0 if no story breaks a rule, 1 if one does, 2 if the arguments are wrong, and 130 after Ctrl-C,
which lets the story that is played come to its end. A second Ctrl-C does not.
"""

import argparse
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial

from tests.endurance.chaos._mutants import MUTANTS as LOCKS
from tests.endurance.explore._stage import Outcome
from tests.endurance.explore._story import draw, play
from tests.support.mutants import HOW
from tests.system.siege_minimised import fewest

_TELL_S = 30.0

MUTANTS: dict[str, Callable[[], None]] = {**LOCKS, **{name: partial(how, setattr) for name, how in HOW.items()}}
"""The ways of `make mutants` to break the product."""


@dataclass
class Sum:
    """What was played so far."""

    began: float = field(default_factory=time.monotonic)
    reported_at: float = field(default_factory=time.monotonic)
    stories: int = 0
    virtual_s: float = 0.0
    calls: int = 0
    wrong: list[int] = field(default_factory=list)
    troubles: Counter[str] = field(default_factory=Counter[str])
    robots: Counter[str] = field(default_factory=Counter[str])
    gateways: int = 0

    def add(self, outcome: Outcome) -> None:
        self.stories += 1
        self.virtual_s += outcome.elapsed_s
        self.calls += outcome.calls
        self.troubles.update(one.name for one in outcome.troubles)
        self.robots.update(one.group for one in outcome.cast.robots)
        self.gateways += outcome.cast.gateway
        if outcome.violations:
            self.wrong.append(outcome.seed)

    def __str__(self) -> str:
        groups = ", ".join(f"{name} {count}" for name, count in sorted(self.robots.items()))
        troubles = ", ".join(f"{name} {count}" for name, count in sorted(self.troubles.items()))
        hours = f"{self.stories} stories, {self.virtual_s / 3600:.3f} virtual hours, {self.calls} calls"
        wrong = f"{len(self.wrong)} with a violation{': ' if self.wrong else ''}{', '.join(map(str, self.wrong))}"
        return f"robots: {groups}; with a gateway: {self.gateways}\ntroubles: {troubles}\n{hours}, {wrong}"

    def tell(self, seeds: int) -> None:
        """Tell how far it is, now and then: not in the output, which is the same each time."""
        now = time.monotonic()
        if now - self.reported_at >= _TELL_S:
            self.reported_at = now
            print(
                f"{self.stories} of {seeds} stories in {now - self.began:.0f} s, {len(self.wrong)} with a violation",
                file=sys.stderr,
                flush=True,
            )


def main(words: Sequence[str] | None = None) -> int:
    asked = _asked(words)
    if asked.mutant:
        MUTANTS[asked.mutant]()
    found = Sum()
    with _interrupts() as interrupts, suppress(KeyboardInterrupt):
        for seed in range(asked.first, asked.first + asked.seeds):
            _play(seed, asked, found)
            found.tell(asked.seeds)
            if interrupts or (asked.mutant and found.wrong):
                break
    if interrupts:
        print(f"interrupted after {found.stories} of {asked.seeds} stories", file=sys.stderr)
    print(found)
    took_s = time.monotonic() - found.began
    print(f"{took_s:.0f} s, {found.stories / max(took_s, 1e-9):.2f} stories a second", file=sys.stderr)
    return 130 if interrupts else int(bool(found.wrong))


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Collects the first Ctrl-C: as an exception it would be lost in the callback of a weak reference."""
    come: list[int] = []

    def note(number: int, _frame: object) -> None:
        come.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield come
    finally:
        signal.signal(signal.SIGINT, before)


def _play(seed: int, asked: argparse.Namespace, found: Sum) -> None:
    outcome = play(seed, asked.only)
    found.add(outcome)
    if not outcome.violations:
        if not asked.quiet:
            print(outcome, flush=True)
        return
    print(outcome, *outcome.violations, sep="\n  ", flush=True)
    if asked.mutant:
        return
    again = f"make explore SEEDS=1 ARGS='--first {seed}"
    print(f"  again: {again}{'' if asked.only is None else ' --only ' + ','.join(map(str, asked.only))}'", flush=True)
    numbers = [one.number for one in outcome.troubles]
    if len(numbers) > 1:
        few = fewest(numbers, lambda some: bool(play(seed, some).violations))
        print(f"  the fewest troubles: {again} --only {','.join(map(str, few))}'", flush=True)


def _asked(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="make explore", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=_positive, default=50, help="how many stories to play (default: 50)")
    parser.add_argument("--first", type=_natural, default=1, help="the seed of the first one (default: 1)")
    parser.add_argument("--only", type=_numbers, help="the numbers of the troubles to keep, such as 0,2; of one story")
    parser.add_argument("--mutant", choices=MUTANTS, help="break the product in this way; ends when that is seen")
    parser.add_argument("--quiet", action="store_true", help="print only what was wrong, and the sum")
    asked = parser.parse_args(words)
    if asked.only is not None and asked.seeds != 1:
        parser.error(f"--only is about the troubles of one story, and {asked.seeds} are asked for: add SEEDS=1")
    if asked.only is not None:
        _, _, troubles = draw(asked.first)
        if unknown := set(asked.only) - {one.number for one in troubles}:
            there = ", ".join(map(str, troubles))
            parser.error(f"story {asked.first} has no trouble {', '.join(map(str, sorted(unknown)))}; it has {there}")
    return asked


def _natural(word: str) -> int:
    if not word.isdecimal():
        raise argparse.ArgumentTypeError(f"{word!r} is not a whole number from 0 on")
    return int(word)


def _positive(word: str) -> int:
    if not _natural(word):
        raise argparse.ArgumentTypeError("0 stories show nothing; ask for 1 at least")
    return int(word)


def _numbers(words: str) -> list[int]:
    if not words:
        raise argparse.ArgumentTypeError("name at least one trouble; without --only, all of them are kept")
    return [_natural(word) for word in words.split(",")]


if __name__ == "__main__":
    sys.exit(main())
