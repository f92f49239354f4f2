"""Runs what failed again at the end: alone, one after the other, three times (`--rerun`).

Tests on real clocks may fail because other tests kept the computer busy. Alone they have it to themselves, so a fault
of the product fails there, too. What passes three times is listed as unsteady with what failed, to be fixed; anything
else fails the run. More than `_MOST_UNSTEADY` are no accident, so they run only once and fail the run.
"""

import os
import subprocess
import sys
from typing import Final

import pytest

_MOST_UNSTEADY: Final = 12
_ROUNDS: Final = 3
_LONGEST_ROUND_S: Final = 1800
_NO_RERUN: Final = ("-n", "0", "-p", "no:tests.support.rerun", "-p", "no:cacheprovider")


class Rerun:
    """The plug-in, in the process that the user sees."""

    def __init__(self) -> None:
        self._failed: dict[str, str] = {}
        self._failed_again: dict[str, int] = {}
        self._lines: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember what failed, and how."""
        if report.failed:
            self._failed.setdefault(report.nodeid, f"{report.when}:\n{report.longreprtext}")

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Run the failed tests again, and decide."""
        if session.exitstatus != pytest.ExitCode.TESTS_FAILED or not self._failed:
            return
        if len(self._failed) > _MOST_UNSTEADY:
            self._lines = [f"{len(self._failed)} failed; {_MOST_UNSTEADY} at most run again"]
            return
        for number in range(1, _ROUNDS + 1):
            code, said = self._run_alone(session.config)
            if code != pytest.ExitCode.OK:
                self._lines = [f"failed also alone, in round {number} of {_ROUNDS}:", said]
                return
        session.exitstatus = pytest.ExitCode.OK
        self._lines = [f"{name} failed at {what}\n" for name, what in self._failed.items()]
        self._lines.insert(0, f"unsteady: {len(self._failed)}; each passed {_ROUNDS} times alone. Fix them:")

    def _run_alone(self, config: pytest.Config) -> tuple[int, str]:
        command = [sys.executable, "-m", "pytest", "-q", *_NO_RERUN, *self._failed]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
        try:
            done = subprocess.run(  # noqa: PLW1510 - its exit code is what is asked for
                command, cwd=config.rootpath, env=environment, capture_output=True, text=True, timeout=_LONGEST_ROUND_S
            )
        except subprocess.TimeoutExpired:
            return pytest.ExitCode.INTERRUPTED, f"it took more than {_LONGEST_ROUND_S} s"
        return done.returncode, done.stdout

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say what ran again, and how it went."""
        if self._lines:
            terminalreporter.section("ran again, alone")
            for line in self._lines:
                terminalreporter.line(line)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--rerun`."""
    parser.addoption("--rerun", action="store_true", help="what failed runs again at the end: alone, three times")


def pytest_configure(config: pytest.Config) -> None:
    """Called for a module that is named as a plugin."""
    if config.getoption("--rerun") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Rerun())
