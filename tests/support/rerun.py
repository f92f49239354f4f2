"""A test that was late because the computer stood still runs once more, and the run's summary says which and why.

The devices of these tests have deadlines of milliseconds. Drivers keep their promises by saying so when they were held
up, and who shares a processor with other programs is held up now and then. So a failure counts only if nothing stood
still: a process of its own looks at the clock, and the product's own words for being late count as well. What fails
twice has failed. More than `_MOST` such tests fail the run: that is no accident any more.

Two failures of each process may be without such a reason and still run once more: of thousands of tests one that waits
for too little should not refuse a whole day. The summary shows them with what failed, so that they get fixed.
"""

import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

import pytest
from _pytest.runner import runtestprotocol

_MOST: Final = 12
_STILL_S: Final = 0.04
"""For so long a device of these tests may go unattended."""
_LATE: Final = re.compile(
    r"was held up for [\d.]+ s|did not answer on [^\s;]+( for [\d.]+ s)?|did not answer within \d+ ms"
    r"|no(body| device) answers;|it was away; remove the cause|it heard nothing for too long; remove the cause"
)
_CLOCK: Final = f"""
import os, time
last = time.monotonic()
while os.getppid() == {{parent}}:
    time.sleep(0.01)
    now = time.monotonic()
    if now - last > 0.01 + {_STILL_S}:
        print(now - last - 0.01, flush=True)
    last = now
"""
_KEY: Final = "ran again"
_UNSTEADY: Final = "for no known reason, fix it: "
_UNSTEADY_ONES: Final = 2
_FAILURES: Final = "TEST_FAILURES"
"""The variable that names a file for a line of each failure: `make test` shows those of all its parts at its end."""


class Clock:
    """A process that does nothing but look whether it is woken in time."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-S", "-c", _CLOCK.format(parent=os.getpid())], stdout=subprocess.PIPE, bufsize=0
        )
        assert self._process.stdout is not None
        self._said = self._process.stdout
        os.set_blocking(self._said.fileno(), False)

    def stood_still_s(self) -> float:
        """For how long at once, since this was asked last."""
        words = self._said.read() or b""
        return max(map(float, words.split()), default=0.0)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        self._said.close()


class Again:
    """The plugin; in each process that runs tests."""

    def __init__(self) -> None:
        self._clock = Clock()
        self._unsteady_left = _UNSTEADY_ONES
        self._once_more: list[pytest.TestReport] | None = None

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool:
        """Run one test, and once more if that one was late."""
        if self._once_more is not None:
            self._once_more.extend(runtestprotocol(item, nextitem=nextitem, log=False))
            return True
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        self._clock.stood_still_s()
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        if (why := self._late(reports) or self._unsteady(reports)) and _afresh(item):
            item.user_properties.append((_KEY, why))
            reports = self._once_more = []
            # By way of the hook, so that this run has a time limit of its own, too.
            item.ihook.pytest_runtest_protocol(item=item, nextitem=nextitem)
            self._once_more = None
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def pytest_unconfigure(self) -> None:
        self._clock.close()

    def _late(self, reports: list[pytest.TestReport]) -> str:
        """Why it may have failed through no fault of its own; empty if it has not, or there is no such reason."""
        failed = [report for report in reports if report.failed]
        if not failed:
            return ""
        time.sleep(0.05)  # what the clock has to say of the last moment
        still_s = self._clock.stood_still_s()
        if still_s:
            return f"the computer stood still for {still_s:.2f} s"
        found = next(filter(None, (_LATE.search(report.longreprtext) for report in failed)), None)
        return "" if found is None else f"it said: {found.group()}"

    def _unsteady(self, reports: list[pytest.TestReport]) -> str:
        """What failed, if there is still one to be let off without a reason."""
        failed = next((report for report in reports if report.failed), None)
        if failed is None or not self._unsteady_left:
            return ""
        self._unsteady_left -= 1
        return _UNSTEADY + failed.longreprtext


def _afresh(item: pytest.Item) -> bool:
    """Have it make all that it needs again, also what whole modules share; False if the old ones cannot be ended."""
    try:
        item.session._setupstate.teardown_exact(None)
    except Exception:  # noqa: BLE001 - the failure that there is says more
        return False
    item._initrequest()  # type: ignore[attr-defined]
    return True


class RerunSummary:
    """The summary, in the process that the user sees."""

    def __init__(self) -> None:
        self._again: dict[str, str] = {}
        self._failed: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember who ran again, and who failed."""
        if report.failed:
            crash = getattr(report.longrepr, "reprcrash", None)
            why = str(getattr(crash, "message", report.longreprtext)).strip().partition("\n")[0]
            self._failed.append(f"{report.nodeid} ({report.when}): {why}")
        for key, why in report.user_properties:
            if key == _KEY:
                self._again[report.nodeid] = str(why)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Too many of them is a failure."""
        if len(self._again) > _MOST and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
            self._failed.extend(f"{name} ran twice, one of more than {_MOST}" for name in self._again)
        if path := os.environ.get(_FAILURES):
            with Path(path).open("a", encoding="utf-8") as file:
                file.writelines(f"{line}\n" for line in self._failed)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say who ran again."""
        if self._again:
            terminalreporter.section(f"ran twice: {len(self._again)} (more than {_MOST} are a failure)")
            for name, why in self._again.items():
                terminalreporter.line(f"{name}: {why}")


def pytest_configure(config: pytest.Config) -> None:
    """Called for a module that is named as a plugin."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(RerunSummary())
    if hasattr(config, "workerinput") or not getattr(config.option, "numprocesses", None):
        config.pluginmanager.register(Again())
