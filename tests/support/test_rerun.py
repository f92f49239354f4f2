"""What failed runs again at the end, alone and three times; tests of `rerun`, in a run of their own."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.realtime

COUNTING = """
import pathlib

def test_it():
    seen = pathlib.Path(__file__).with_suffix(".seen")
    attempts = seen.read_text() if seen.exists() else ""
    seen.write_text(attempts + "x")
    assert {passes}
"""


def _run(tmp_path: Path, *options: str, **modules: str) -> tuple[int, str]:
    """A run of tests which pass if `passes` holds for the attempts before, one letter each."""
    for name, passes in modules.items():
        (tmp_path / f"test_{name}.py").write_text(COUNTING.format(passes=passes))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.support.rerun", "--rerun", *options, "."]
    done = subprocess.run(  # noqa: PLW1510 - its exit code is what is asked for
        command,
        cwd=tmp_path,
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin", "PYTEST_ADDOPTS": "-c /dev/null"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    return done.returncode, done.stdout


def _attempts(tmp_path: Path, name: str) -> int:
    return len((tmp_path / f"test_{name}.seen").read_text())


def test_what_passes_three_times_alone_is_unsteady_and_the_run_passes(tmp_path: Path) -> None:
    code, said = _run(tmp_path, once="len(attempts) > 0, 'too late by 3 ms'", steady="True")
    assert code == 0, said
    assert "unsteady: 1; each passed 3 times alone" in said
    assert "test_once.py::test_it failed at call" in said
    assert "too late by 3 ms" in said
    assert _attempts(tmp_path, "once") == 4
    assert _attempts(tmp_path, "steady") == 1


@pytest.mark.parametrize("passes", ["False", "len(attempts) == 1", "len(attempts) in (1, 2)"])
def test_what_fails_alone_once_of_three_times_fails_the_run(tmp_path: Path, passes: str) -> None:
    code, said = _run(tmp_path, flaw=f"{passes}")
    assert code == 1, said
    assert "failed also alone, in round" in said


def test_a_run_without_failures_runs_nothing_again(tmp_path: Path) -> None:
    code, said = _run(tmp_path, steady="True")
    assert code == 0, said
    assert "ran again" not in said
    assert _attempts(tmp_path, "steady") == 1


@pytest.mark.parametrize("number", [12, 13])
def test_more_than_twelve_are_not_run_again(tmp_path: Path, number: int) -> None:
    code, said = _run(tmp_path, **{f"t{n}": "len(attempts) > 0" for n in range(number)})
    assert code == (number > 12), said
    assert _attempts(tmp_path, "t0") == (1 if number > 12 else 4)


def test_failures_in_workers_are_run_again_too(tmp_path: Path) -> None:
    code, said = _run(tmp_path, "-n", "2", once="len(attempts) > 0", steady="True")
    assert code == 0, said
    assert "unsteady: 1" in said


def test_a_module_that_cannot_be_read_is_not_excused(tmp_path: Path) -> None:
    (tmp_path / "test_broken.py").write_text("import nothing_of_that_name\n")
    code, said = _run(tmp_path, steady="True")
    assert code == 2, said
