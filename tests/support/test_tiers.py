"""What a test of one tier must not do is refused, and fails it even if the refusal was caught."""

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]
pytestmark = pytest.mark.realtime

FORBIDDEN = {
    "starts a process": "import subprocess, sys; subprocess.run([sys.executable, '-c', 'open(\"ran\", \"w\")'])",
    "starts a process (os.fork)": "import os; os.fork() or os._exit(0)",
    "starts a process (os.system)": "import os; os.system('touch ran')",
    "opens a pseudo-terminal": "import os; os.openpty()",
    "opens a socket of a simulator": "from trade_hil_sim.can._hub import Hub; Hub('can0', None).open()",
}


@pytest.fixture
def run(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch):
    """Runs a test with this body in a run of its own."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    pytester.makeini(
        "[pytest]\naddopts = -p tests.support.tiers -p no:cacheprovider\nmarkers =\n  realtime: x\n  system: x\n"
    )

    def run(body: str, mark: str = "") -> pytest.RunResult:
        lines = "\n".join(f"    {line}" for line in body.split("\n"))
        pytester.makepyfile(f"import pytest\n{mark}\ndef test_it():\n{lines}\ndef test_innocent(): ...\n")
        return pytester.runpytest_subprocess("-q", "-W", "ignore")

    return run


@pytest.mark.parametrize("did", FORBIDDEN)
def test_the_first_tier_refuses(did: str, run, pytester: pytest.Pytester) -> None:
    result = run(FORBIDDEN[did])
    result.stdout.fnmatch_lines([f"*this test {did.replace('[', '[[]')}*: mark it with @pytest.mark.realtime*"])
    assert result.ret == 1
    assert not (pytester.path / "ran").exists()


@pytest.mark.parametrize("did", [did for did in FORBIDDEN if "simulator" not in did])
def test_what_is_marked_may_do_it(did: str, run) -> None:
    run(FORBIDDEN[did], "@pytest.mark.realtime").assert_outcomes(passed=2)


def test_a_refusal_that_was_caught_fails_the_test_and_no_other(run) -> None:
    result = run("import os\ntry: os.system('true')\nexcept Exception: pass")
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*this test starts a process (os.system): mark it with*"])


def test_a_thread_of_the_test_is_refused_too(run) -> None:
    result = run("import os, threading\nt = threading.Thread(target=os.system, args=('true',))\nt.start(); t.join()")
    result.assert_outcomes(passed=2, errors=1)


@pytest.mark.parametrize(
    ("command", "did"), [("['ip', 'netns', 'list']", "uses network namespaces"), ("['chromium']", "starts a browser")]
)
def test_the_second_tier_refuses_what_belongs_into_the_third(command: str, did: str, run) -> None:
    result = run(f"import subprocess; subprocess.run({command})", "@pytest.mark.realtime")
    result.stdout.fnmatch_lines([f"*this test {did}: mark it with @pytest.mark.system*"])
    assert result.ret == 1


def test_a_long_test_is_listed_and_passes(run) -> None:
    result = run("import time; time.sleep(2.1)")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*longer than 2 s*", "2.1 s *::test_it"])
