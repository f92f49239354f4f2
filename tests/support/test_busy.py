"""A failure on a busy computer is a skip with a figure, in runs of their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TEST = """import pytest, time
@pytest.mark.{mark}
@pytest.mark.parametrize('number', range({times}))
def test_it(number):
    {body}
"""
LATE = "sum(range(10_000_000)); time.sleep(0.05)"
"""All other threads wait for 0.1 s and more, as they do when the computer has no time for this process."""
LATE_AND_WRONG = f"{LATE}; assert not 'no answer'"


def _run(
    tmp_path: Path, body: str, times: int = 1, *, others: int = 0, folder: str = "contract", mark: str = "slow"
) -> tuple[int, str]:
    place = tmp_path / "tests" / folder
    place.mkdir(parents=True)
    (place / "test_one.py").write_text(TEST.format(times=times, body=body, mark=mark))
    (place / "test_others.py").write_text(TEST.format(times=others, body="pass", mark=mark) if others else "")
    options = "-q -rs -p tests.support.busy -p no:cacheprovider -c /dev/null --rootdir ."
    done = subprocess.run(  # noqa: PLW1510 - its exit code is what is asked for
        [sys.executable, "-m", "pytest", *options.split(), "."],
        cwd=tmp_path,
        env={
            **os.environ,
            "PYTHONPATH": str(Path(__file__).parents[2]),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
            "CI": "true",
        },
        capture_output=True,
        text=True,
        timeout=60,
    )
    return done.returncode, done.stdout


def test_a_late_test_on_a_real_clock_that_fails_is_skipped_with_the_figure_and_its_failure(tmp_path: Path) -> None:
    code, said = _run(tmp_path, LATE_AND_WRONG)
    assert code == 0, said
    assert "1 skipped" in said
    assert "the computer was too busy: a byte was late by " in said
    assert "the computer was too busy: 1 of 1 tests on a real clock" in said
    assert "AssertionError: assert not 'no answer'" in said


def test_a_test_that_was_not_late_has_failed(tmp_path: Path) -> None:
    code, said = _run(tmp_path, "assert not 'no answer'")
    assert code == 1, said
    assert "1 failed" in said


@pytest.mark.parametrize(
    "mistake",
    [
        "from tests.support.busy import BuildError; raise BuildError('no compiler')",
        "import missing_module",
        "missing_name",
        "number.missing_attribute",
        "number()",
    ],
)
def test_what_no_lateness_explains_has_failed_however_late_it_was(tmp_path: Path, mistake: str) -> None:
    code, said = _run(tmp_path, f"{LATE}; {mistake}")
    assert code == 1, said
    assert "1 failed" in said


@pytest.mark.parametrize("mark", ["mutant", "own_load"])
def test_a_test_that_keeps_the_computer_busy_itself_has_failed_however_late_it_was(tmp_path: Path, mark: str) -> None:
    code, said = _run(tmp_path, LATE_AND_WRONG, mark=mark)
    assert code == 1, said
    assert "1 failed" in said


def test_a_late_test_without_a_real_clock_has_failed(tmp_path: Path) -> None:
    code, said = _run(tmp_path, LATE_AND_WRONG, folder="unit/trade")
    assert code == 1, said
    assert "1 failed" in said


def test_a_late_test_that_passes_has_passed(tmp_path: Path) -> None:
    code, said = _run(tmp_path, LATE)
    assert code == 0, said
    assert "1 passed" in said


@pytest.mark.parametrize(("late", "passes"), [(1, True), (2, False)])
def test_in_ci_more_than_one_percent_of_such_tests_fail_the_run(tmp_path: Path, late: int, passes: bool) -> None:
    code, said = _run(tmp_path, LATE_AND_WRONG, late, others=100 - late)
    assert (code == 0) == passes, said
    assert f"{late} of 100 tests on a real clock" in said
