"""The checker finds nothing where the locks are right, and something wherever they are not."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.endurance.chaos._mutants import MUTANTS

ROOT = Path(__file__).parents[3]
_TRIES = 6
PATHS = {"local path": "1", "transport": "0"}
SPEED = {"seconds": "5", "clients": "4", "threads": "10"}


def chaos(mutant: str = "", path: str = "local path", **options: str) -> subprocess.CompletedProcess[str]:
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    return subprocess.run(
        [sys.executable, "-m", "tests.endurance.chaos", *words],
        cwd=ROOT,
        env={**os.environ, "TRADE_MUTANT": mutant, "TRADE_LOCAL_PATH": PATHS[path]},
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )


def counted(printed: str) -> Callable[[str], int]:
    counts = dict(re.findall(r"^  (\S.*?) +(\d+)$", printed, re.MULTILINE))
    return lambda name: int(counts.get(name, 0))


@pytest.mark.parametrize("path", PATHS)
def test_locks_hold_under_fifty_faults_of_each_kind(path: str) -> None:
    done = chaos(path=path, seconds="20", clients="5", threads="20")
    assert done.returncode == 0, done.stdout + done.stderr
    count = counted(done.stdout)
    assert min(count(f"fault {kind}") for kind in ("kill", "freeze", "delay", "cut")) >= 50
    assert min(count(kind) for kind in ("grant", "held", "command", "byte")) > 20  # it was about something


@pytest.mark.mutant
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("mutant", MUTANTS)
def test_broken_locks_are_found(mutant: str, path: str) -> None:
    """Within a few short runs: one alone may pass before the moment comes in which it shows."""
    for seed in range(1, _TRIES + 1):
        done = chaos(mutant, path, seed=str(seed), **SPEED)
        assert f"violations (seed {seed})" in done.stdout
        assert "Traceback" not in done.stderr
        if done.returncode == 1:
            return
    raise AssertionError(f"{_TRIES} runs found nothing:\n{done.stdout}{done.stderr}")


def test_a_mutant_that_does_not_exist_proves_nothing() -> None:
    done = chaos("no-such-mutant", seconds="1", clients="1", threads="1", drivers="1")
    assert "KeyError: 'no-such-mutant'" in done.stderr
    assert "violations" not in done.stdout
