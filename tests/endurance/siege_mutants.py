"""A siege detects drivers that are broken in one way; `make mutants` runs this, which needs minutes and root.

Each siege has only those troubles in which its mutant can show. With all of them, half a minute had one end of a
client, perhaps while nothing moved for it: three sieges in a row showed nothing of `nothing-stops`.
"""

import re

import pytest

from tests.support.mutants import PATHS
from tests.system.siege_minimised import besiege

SHOWS_IN = {
    "anybody-may": ("clock",),
    "nothing-stops": ("kill client", "freeze client", "cut"),
    "watchdog-off": ("kill driver", "freeze driver", "unplug"),
    "never-late": ("delay",),
    "no-stop-line": ("strangers",),
}
"""By mutant, the troubles in which it shows. The other mutants need a moment that a siege may not meet."""
_MINUTES = 0.9
_SEEDS = (1, 2, 3, 4, 5)


@pytest.mark.mutant
@pytest.mark.realtime
@pytest.mark.timeout(2000)
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("mutant", SHOWS_IN)
def test_a_siege_detects_a_broken_driver(mutant: str, path: str) -> None:
    assert any(_violates(mutant, path, seed) for seed in _SEEDS), f"{len(_SEEDS)} sieges detected nothing"


def _violates(mutant: str, path: str, seed: int) -> bool:
    """Whether the judge of a siege found a violation; any other failure is no evidence and raises."""
    kinds = ",".join(SHOWS_IN[mutant])
    settings = {"SIEGE_MUTANT": mutant, "SIEGE_KINDS": kinds, "SEED": str(seed), "TRADE_LOCAL_PATH": PATHS[path]}
    done = besiege(_MINUTES, **settings)
    if done.returncode == pytest.ExitCode.OK:
        return False
    assert re.search(r"^E +the notes of all are kept", done.stdout, re.MULTILINE), done.stdout + done.stderr
    return True
