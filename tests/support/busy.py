"""A test on a real clock that fails while the computer is too busy is skipped, with a figure.

Simulated devices and drivers have deadlines of milliseconds. A thread of the same process sends a byte through a
pseudo-terminal each 10 ms, as they do, and notes how late it arrives: it waits for the processor, for a thread of the
kernel and for the interpreter. A failure counts as "the computer was too busy" only in a test on a real clock, and only
if a byte was late by `TOO_LATE_S` in that test. The summary shows it with its figure and its failure. With CI=true,
more than 1 % of such tests fail the run. No test runs a second time.

A test that keeps the computer busy itself is always late, so lateness does not excuse it: those marked `own_load` or
`mutant`. They judge by logs of bytes and records of calls, whose times they know.
"""

import os
import pty
import select
import threading
import time
import tty
from pathlib import Path
from typing import Final

import pytest

TOO_LATE_S: Final = 0.02
"""An exchange with a simulated device may take 48 ms, and has bytes in both directions."""
REAL_CLOCK: Final = (
    "tests/bench/",
    "tests/contract/",
    "tests/docs/",
    "tests/endurance/",
    "tests/system/",
    "tests/unit/drivers/",
    "tests/unit/gateway/",
    "tests/unit/hil_sim/",
    "tests/unit/ros/",
)
"""Where devices are simulated in real time."""
_NO_EXCUSE: Final = ("mutant", "own_load")
"""Marks of tests that keep the computer busy themselves."""
_MOST: Final = 0.01
_EACH_S: Final = 0.01
_LONGEST_MS: Final = 10_000
_KEY: Final = "too busy"
_FAILURES: Final = "TEST_FAILURES"
"""The variable that names a file for a line of each failure: the Makefile shows those of all parts at its end."""


class BuildError(Exception):
    """A compiler or another tool failed: a failure that is never the computer's lateness."""


_NEVER_LATE: Final = (BuildError, AttributeError, ImportError, NameError, SyntaxError, TypeError)
"""Failures that no lateness explains."""


class Lateness:
    """By how much a byte was late in this process, since this was asked last."""

    def __init__(self) -> None:
        self._worst_s = 0.0
        self._closed = threading.Event()
        self._ends = pty.openpty()
        tty.setraw(self._ends[1])
        self._thread = threading.Thread(target=self._run, name="lateness", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        far, near = self._ends
        arrived = select.poll()
        arrived.register(near, select.POLLIN)
        due = time.monotonic() + _EACH_S
        while not self._closed.wait(max(0.0, due - time.monotonic())):
            os.write(far, b"x")
            if arrived.poll(_LONGEST_MS):
                os.read(near, 1)
            now = time.monotonic()
            self._worst_s = max(self._worst_s, now - due)
            due = now + _EACH_S

    def take_s(self) -> float:
        """The greatest lateness since the last call."""
        worst_s, self._worst_s = self._worst_s, 0.0
        return worst_s

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        self._thread.join()
        for end in self._ends:
            os.close(end)


class BusyComputer:
    """The plug-in in each process that runs tests."""

    def __init__(self) -> None:
        self._lateness = Lateness()
        self._skipped = ""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> pytest.TestReport:
        """Turn the failure of a late test into a skip, and what it then leaves behind, too."""
        report: pytest.TestReport = yield
        late_s = self._lateness.take_s()
        why = f"the computer was too busy: a byte was late by {late_s:.3f} s"
        late = item.nodeid == self._skipped if call.when == "teardown" else late_s >= TOO_LATE_S
        by_time = call.excinfo is not None and not call.excinfo.errisinstance(_NEVER_LATE)
        excusable = by_time and not any(map(item.get_closest_marker, _NO_EXCUSE))
        if report.failed and late and excusable and item.nodeid.startswith(REAL_CLOCK):
            self._skipped = item.nodeid
            report.user_properties.append((_KEY, f"{why}; it failed with:\n{report.longreprtext}"))
            report.outcome = "skipped"
            report.longrepr = (str(item.path), item.location[1] or 0, why)
        return report

    def pytest_unconfigure(self) -> None:
        self._lateness.close()


class BusySummary:
    """The summary, in the process that the user sees."""

    def __init__(self) -> None:
        self._on_real_clock: set[str] = set()
        self._busy: dict[str, str] = {}
        self._failed: list[str] = []
        self._failures = os.environ.pop(_FAILURES, "")  # not for runs that tests start

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember who was skipped, and who failed."""
        if report.nodeid.startswith(REAL_CLOCK):
            self._on_real_clock.add(report.nodeid)
        if report.failed:
            crash = getattr(report.longrepr, "reprcrash", None)
            why = str(getattr(crash, "message", report.longreprtext)).strip().partition("\n")[0]
            self._failed.append(f"{report.nodeid} ({report.when}): {why}")
        for why in (text for key, text in report.user_properties if key == _KEY):
            self._busy[report.nodeid] = str(why)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """In CI, too many of them are a failure."""
        too_many = len(self._busy) > max(1, _MOST * len(self._on_real_clock))
        if too_many and os.environ.get("CI") == "true" and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
            self._failed.extend(f"{name} was skipped, one of too many: {why}" for name, why in self._busy.items())
        if self._failures:
            with Path(self._failures).open("a", encoding="utf-8") as file:
                file.writelines(f"{line}\n" for line in self._failed)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Show who was skipped, and how each failed."""
        if self._busy:
            share = f"{len(self._busy)} of {len(self._on_real_clock)} tests on a real clock"
            terminalreporter.section(f"the computer was too busy: {share} (in CI, more than 1 % fail the run)")
            for name, why in self._busy.items():
                terminalreporter.line(f"{name}: {why}")


def pytest_configure(config: pytest.Config) -> None:
    """Register the plug-ins: one where tests run, one where the summary is printed."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(BusySummary())
    if hasattr(config, "workerinput") or not getattr(config.option, "numprocesses", None):
        config.pluginmanager.register(BusyComputer())
