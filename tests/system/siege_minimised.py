"""The fewest kinds of trouble under which a siege still fails, by leaving some out: ``make siege MINIMISE=1``.

Each try is a siege of its own with the same seed, of ``SIEGE_MINUTES`` but at most 1.5. A siege is not the same twice,
so a kind that was left out may have had its part, and one that is named may have none.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

_TEST = Path(__file__).with_name("test_siege.py")
_MOST_MINUTES = 1.5
_STARTS_AND_ENDS_S = 400.0


_T = TypeVar("_T")


def fewest(kinds: Sequence[_T], fails: Callable[[Sequence[_T]], bool]) -> list[_T]:
    """Leave out halves, quarters and so on, down to each alone, whatever it fails without."""
    left, size = [*kinds], len(kinds) // 2
    while size:
        for some in [left[at : at + size] for at in range(0, len(left), size)]:
            rest = [kind for kind in left if kind not in some]
            if rest and fails(rest):
                left = rest
        size //= 2
    return left


def besiege(minutes: float, **settings: str) -> "subprocess.CompletedProcess[str]":
    """Runs one siege in a process of its own, with more settings in its environment."""
    options = ("-q", "-n", "0", "-k", "whatever_faults_occur")
    return subprocess.run(
        [sys.executable, "-m", "pytest", *options, str(_TEST)],
        env={**os.environ, "SIEGE_MINUTES": str(minutes), **settings},
        capture_output=True,
        text=True,
        timeout=120 * minutes + _STARTS_AND_ENDS_S,
        check=False,
    )


def _fails(kinds: Sequence[str]) -> bool:
    print(f"with {', '.join(kinds)}: ", end="", flush=True)
    minutes = min(_MOST_MINUTES, float(os.environ.get("SIEGE_MINUTES", "1")))
    failed = besiege(minutes, SIEGE_KINDS=",".join(kinds)).returncode != 0
    print("fails" if failed else "passes", flush=True)
    return failed


def main() -> None:
    from tests.system.siege import TROUBLES

    print(f"fails at least with: {', '.join(fewest([*TROUBLES], _fails))}")


if __name__ == "__main__":
    main()
