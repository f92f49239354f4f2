"""Who is late runs once more, who is wrong does not; tests of `rerun`, in a run of their own."""

import subprocess
import sys
from pathlib import Path

import pytest

LATE = """
import pathlib, signal, os, time, pytest
from trade.errors import MotionStopped

@pytest.fixture
def ready():
    yield "fresh"

def test_it(ready):
    seen = pathlib.Path(__file__).with_suffix(".seen")
    first = not seen.exists()
    seen.touch()
    assert ready == "fresh"
    {body}
"""


def _run(tmp_path: Path, body: str, times: int = 1, options: tuple[str, ...] = ()) -> tuple[int, str]:
    for number in range(times):
        (tmp_path / f"test_late{number}.py").write_text(LATE.format(body=body))
    done = subprocess.run(  # noqa: PLW1510 - its exit code is what is asked for
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "tests.support.rerun",
            "-p",
            "no:cacheprovider",
            "-c",
            "/dev/null",
            "--rootdir",
            ".",
            *options,
            ".",
        ],
        cwd=tmp_path,
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize(
    "said",
    [
        "was held up for 0.35 s",
        "did not answer on /dev/x for 0.3 s",
        "did not answer on /dev/x",
        "did not answer within 36 ms",
        "it heard nothing for too long; remove the cause",
        "it was away; remove the cause",
    ],
)
def test_a_test_that_is_late_once_reruns_and_is_reported(tmp_path: Path, said: str) -> None:
    code, reported = _run(tmp_path, f"assert not first, 'its driver {said}'")
    assert code == 0, reported
    assert "ran twice: 1" in reported
    assert f"test_late0.py::test_it: it said: {said}" in reported


def test_a_test_that_failed_once_without_such_a_reason_passes_and_is_shown(tmp_path: Path) -> None:
    code, said = _run(tmp_path, "assert not first")
    assert code == 0, said
    assert "test_late0.py::test_it: for no known reason, fix it: " in said
    assert ">       assert not first" in said or ">   assert not first" in said


def test_a_third_failure_does_not_pass(tmp_path: Path) -> None:
    code, said = _run(tmp_path, "assert not first", 3)
    assert code == 1
    assert "1 failed, 2 passed" in said


def test_a_test_that_fails_twice_has_failed(tmp_path: Path) -> None:
    code, said = _run(tmp_path, "assert False")
    assert code == 1
    assert "1 failed" in said


def test_a_test_that_is_late_twice_has_failed(tmp_path: Path) -> None:
    code, said = _run(tmp_path, "assert False, 'its driver was held up for 0.35 s'")
    assert code == 1
    assert "1 failed" in said


def test_a_late_module_fixture_is_set_up_again(tmp_path: Path) -> None:
    (tmp_path / "test_shared.py").write_text(
        "import pytest\n"
        "made = []\n"
        "@pytest.fixture(scope='module')\n"
        "def shared():\n"
        "    made.append(1)\n"
        "    assert len(made) > 1, 'its driver was held up for 0.35 s'\n"
        "def test_one(shared): ...\n"
        "def test_two(shared): assert len(made) == 2\n"
    )
    code, said = _run(tmp_path, "", times=0)
    assert code == 0, said
    assert "2 passed" in said


@pytest.mark.parametrize("times", [12, 13])
def test_too_many_of_them_fail_the_run(tmp_path: Path, times: int) -> None:
    code, said = _run(tmp_path, "assert not first, 'j1 did not answer on /dev/x for 0.3 s; is it powered'", times)
    assert code == (times > 12)
    assert f"{times} passed" in said


def test_a_computer_that_was_suspended_is_a_reason(tmp_path: Path) -> None:
    """The clock that is asked is stopped for a moment, as the whole computer would be."""
    freeze = (
        "import psutil; clock, = psutil.Process().children()\n"
        "    clock.suspend(); time.sleep(0.2); clock.resume(); time.sleep(0.1)\n"
        "    assert not first"
    )
    code, said = _run(tmp_path, freeze)
    assert code == 0, said
    assert "the computer stood still for 0." in said


def test_each_of_the_two_runs_has_the_time_limit_and_only_that_test_fails(tmp_path: Path) -> None:
    (tmp_path / "test_after.py").write_text("def test_after(): ...\n")
    code, said = _run(tmp_path, "time.sleep(60)", options=("--timeout", "1", "--timeout-method", "signal"))
    assert code == 1, said
    assert "1 failed, 1 passed" in said
    assert said.count("Failed: Timeout") > 2, said  # the first is shown in the summary
