"""A table of mutants, each with the test that has to detect it; a plugin for `make mutants`."""

from typing import Final

import pytest

LISTS: Final = {
    "endurance/chaos": "locks",
    "support/test_mutants": "rules and promises",
    "contract/complaints": "complaints",
    "endurance/siege_mutants": "siege",
}
"""The list of mutants of each place, by a part of its path."""


class MutantTable:
    """Collects the results of tests that are marked as `mutant`, and prints them at the end."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, str, str, str]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if "mutant" in report.keywords and (report.when == "call" or not report.passed):
            test, _, mutant = report.nodeid.partition("[")
            kind = next((name for part, name in LISTS.items() if part in test), test)
            result = {"passed": "detected", "skipped": "not tried"}.get(report.outcome, "NOT DETECTED")
            self.rows.append((kind, mutant.removesuffix("]"), result, f"{report.duration:.0f} s"))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if not self.rows:
            return
        rows = [("list", "mutant", "result", "time"), *sorted(self.rows)]
        widths = [max(len(row[column]) for row in rows) for column in range(4)]
        terminalreporter.section(f"{len(self.rows)} mutants")
        for row in rows:
            terminalreporter.line(
                "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            )


def pytest_configure(config: pytest.Config) -> None:
    """Registers the table in the process that prints the summary."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(MutantTable())
