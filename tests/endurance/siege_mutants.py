"""A siege detects drivers that are broken in one way; `make mutants` runs this, which needs minutes and root."""

import re

import pytest

from tests.system.siege_minimised import besiege

MINUTES = {"anybody-may": 0.5, "nothing-stops": 0.5, "watchdog-off": 0.5, "never-late": 1.0, "no-stop-line": 1.0}
"""How long the siege of each mutant lasts. The other mutants need a moment that a siege may not meet."""
_SEEDS = (1, 2, 3)


@pytest.mark.mutant
@pytest.mark.realtime
@pytest.mark.timeout(2000)
@pytest.mark.parametrize("mutant", MINUTES)
def test_a_siege_detects_a_broken_driver(mutant: str) -> None:
    assert any(_fails(mutant, seed) for seed in _SEEDS), f"{len(_SEEDS)} sieges detected nothing"


def _fails(mutant: str, seed: int) -> bool:
    """Whether a siege ends with a violation; any other failure is no evidence and raises."""
    done = besiege(MINUTES[mutant], SIEGE_MUTANT=mutant, SEED=str(seed))
    if done.returncode == pytest.ExitCode.OK:
        return False
    assert re.search(r"^E +AssertionError", done.stdout, re.MULTILINE), done.stdout + done.stderr
    return True
