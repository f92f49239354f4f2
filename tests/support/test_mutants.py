"""Each way of `mutants` to break a driver fails the test of the rule that it breaks."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.endurance.chaos._mutants import MUTANTS
from tests.support.mutants import HOW, PATHS

ROOT = Path(__file__).parents[2]
EVERYWHERE = ROOT / "tests" / "support" / "everywhere"
PAGE = ROOT / "docs" / "testing.md"
_ROW = re.compile(r"^\| `([\w-]+)` \| (.*) \| `([\w/.]+)::(\w+)` \|$", re.MULTILINE)
ROWS = [(mutant, file, test) for mutant, _, file, test in _ROW.findall(PAGE.read_text())]
ON_EITHER_PATH = {"anybody-may", "nothing-stops", "stop-loses"}
"""The mutants of locks and motion whose tests make calls between containers that may take the local path.

The one of no-dedupe makes them by hand, on the transport. Its second row is about both paths at once.
"""
RUNS = [
    pytest.param(mutant, file, test, path, id=f"{mutant}-{path if mutant in ON_EITHER_PATH else Path(file).stem}")
    for mutant, file, test in ROWS
    for path in (PATHS if mutant in ON_EITHER_PATH else ["local path"])
    if mutant in HOW
]


def test_the_page_names_a_test_for_each_of_them() -> None:
    assert {mutant for mutant, _, _ in ROWS} == {*HOW, *MUTANTS}
    assert {test for mutant, _, test in ROWS if mutant in MUTANTS} == {"test_broken_locks_are_found"}


@pytest.mark.realtime
@pytest.mark.mutant
@pytest.mark.parametrize(("mutant", "file", "test", "path"), RUNS)
def test_what_is_broken_is_found_by_the_test_of_its_rule(mutant: str, file: str, test: str, path: str) -> None:
    plugins = ("-p", "tests.support.mutants", "-p", "no:tests.support.busy")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", *plugins, f"{file}::{test}"]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "MUTANT": mutant, "TRADE_LOCAL_PATH": PATHS[path], "PYTHONPATH": f"{EVERYWHERE}:{ROOT}"},
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
