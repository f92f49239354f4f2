"""Each way of `mutants` to break a driver fails the test of the rule that it breaks."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.endurance.chaos._mutants import MUTANTS
from tests.support.mutants import HOW

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "testing.md"
_ROW = re.compile(r"^\| `([\w-]+)` \| (.*) \| `([\w/.]+)::(\w+)` \|$", re.MULTILINE)
ROWS = {mutant: (file, test) for mutant, _, file, test in _ROW.findall(PAGE.read_text())}


def test_the_page_names_a_test_for_each_of_them() -> None:
    assert set(ROWS) == {*HOW, *MUTANTS}
    assert {ROWS[mutant][1] for mutant in MUTANTS} == {"test_broken_locks_are_found"}


@pytest.mark.realtime
@pytest.mark.mutant
@pytest.mark.parametrize("mutant", HOW)
def test_what_is_broken_is_found_by_the_test_of_its_rule(mutant: str) -> None:
    file, test = ROWS[mutant]
    plugins = ("-p", "tests.support.mutants", "-p", "no:tests.support.rerun")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", *plugins, f"{file}::{test}"]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "MUTANT": mutant, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == pytest.ExitCode.TESTS_FAILED, done.stdout + done.stderr
    assert re.search(r"^FAILED ", done.stdout, re.MULTILINE), "it may not fail because of what it is based on"


def test_a_mutant_that_does_not_exist_proves_nothing() -> None:
    with pytest.raises(KeyError):
        HOW["no-such-mutant"](setattr)
