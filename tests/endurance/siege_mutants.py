"""A siege detects drivers that are broken in one way; `make mutants` runs this, which needs minutes and root."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MINUTES = {"anybody-may": 0.5, "nothing-stops": 0.5, "watchdog-off": 0.5, "never-late": 1.0, "no-stop-line": 1.0}
"""How long the siege of each mutant lasts. The other mutants need a moment that a siege may not meet."""
_SEEDS = (1, 2, 3)


@pytest.mark.mutant
@pytest.mark.timeout(2000)
@pytest.mark.parametrize("mutant", MINUTES)
def test_a_siege_detects_a_broken_driver(mutant: str) -> None:
    assert any(_fails(mutant, seed) for seed in _SEEDS), f"{len(_SEEDS)} sieges detected nothing"


def _fails(mutant: str, seed: int) -> bool:
    """Whether a siege ends with a violation; any other failure is no evidence and raises."""
    settings = {"SIEGE_MUTANT": mutant, "SIEGE_MINUTES": str(MINUTES[mutant]), "SEED": str(seed)}
    options = ("-q", "-n", "0", "-p", "no:tests.support.rerun", "-k", "whatever_faults_occur")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "tests/system/test_siege.py"],
        cwd=ROOT,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    if done.returncode == pytest.ExitCode.OK:
        return False
    assert re.search(r"^E +AssertionError", done.stdout, re.MULTILINE), done.stdout + done.stderr
    return True
