"""Speed as ratios against peers in the same run. Numbers are printed, never asserted."""

import argparse

from tests.bench import _calls, _servo


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("parts", nargs="*", help="calls, servo; both by default")
    parser.add_argument("-n", type=int, default=300, help="calls or cycles in a round (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=20, help="turns of each peer (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of a 100 Hz round (default: %(default)s)")
    options = parser.parse_args()
    if unknown := set(options.parts) - {"calls", "servo"}:
        parser.error(f"there is no part {', '.join(unknown)}; there are calls and servo")
    if not options.parts or "calls" in options.parts:
        _calls.run(options.n, options.rounds)
    if not options.parts or "servo" in options.parts:
        _servo.run(options.n, options.rounds, options.seconds)


if __name__ == "__main__":
    main()
