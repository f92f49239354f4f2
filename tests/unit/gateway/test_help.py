"""What ``trade --help`` promises: summaries, examples and panels of commands, and completion by shells."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from trade_gateway._usage import UsageError
from trade_gateway.cli import app, build

pytestmark = pytest.mark.virtual_time

_WIDTH = 80
_MOST_UNGROUPED = 5
"""The most options of a command that need no panel."""
_DEFAULTS = {"trade faults list": "trade faults", "trade audit show": "trade audit"}
"""Commands that their group runs without a subcommand."""
_THEN = re.compile(r", and (?:then|later) ")


def _tree(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yields a command and all its subcommands with their full names."""
    yield name, command
    for word, inner in getattr(command, "commands", {}).items():
        yield from _tree(inner, f"{name} {word}")


ROOT = typer.main.get_command(build())
COMMANDS = dict(_tree(ROOT, "trade"))


def _parse(words: list[str]) -> None:
    """Parses a command line without running it. Raises UsageError of click for unknown commands and options."""
    command: Any = ROOT
    context = command.make_context("trade", words)
    while getattr(command, "commands", {}) and (rest := [*context._protected_args, *context.args]):
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_summary_of_each_command_is_one_sentence_in_one_line(name: str) -> None:
    summary = (COMMANDS[name].help or "").partition("\n\n")[0]
    assert 0 < len(summary) <= _WIDTH
    assert "\n" not in summary
    assert summary.endswith(".")


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_has_an_example_of_itself_that_parses(name: str) -> None:
    _, found, example = (COMMANDS[name].help or "").partition("For example: ")
    assert found, f"the docstring of {name} has no line 'For example: {name} ...'"
    assert example.strip().removeprefix("sudo ").startswith(_DEFAULTS.get(name, name))
    steps = [step.removeprefix("sudo ").partition(" > ")[0] for step in _THEN.split(example.strip().partition("\n")[0])]
    lines = [shlex.split(step) for step in steps if step.startswith("trade ")]
    assert lines
    for line in lines:
        _parse(line[1:])


@pytest.mark.parametrize("name", COMMANDS)
def test_more_than_five_options_are_grouped_in_panels(name: str) -> None:
    options = [one for one in COMMANDS[name].params if one.param_type_name == "option" and not one.hidden]
    ungrouped = [one.opts[0] for one in options if one.rich_help_panel is None]
    assert len(ungrouped) <= _MOST_UNGROUPED, f"{name}: give some of {ungrouped} a rich_help_panel"


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_each_command_fits_a_narrow_terminal(name: str) -> None:
    shown = CliRunner().invoke(build(), [*name.split()[1:], "--help"], env={"COLUMNS": str(_WIDTH)})
    assert shown.exit_code == 0
    assert "For example: trade" in shown.output.replace("sudo ", "")
    assert [line for line in shown.output.splitlines() if len(line) > _WIDTH] == []


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("words", "expected", "other"),
    [("trade lo", {"lock", "locks", "logs"}, "up"), ("trade stream --h", {"--hz", "--help"}, "--json")],
)
def test_words_are_completed(words: str, expected: set[str], other: str) -> None:
    asked = {"_TRADE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    reported = subprocess.run(
        [sys.executable, "-c", "import sys; sys.argv[0] = 'trade'; from trade_gateway.cli import main; main()"],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert expected <= set(reported)
    assert other not in reported


def test_an_option_of_other_servers_is_answered_with_the_one_that_is_meant() -> None:
    said = CliRunner().invoke(app, ["http", "--port", "8080"])
    assert isinstance(said.exception, UsageError)
    assert str(said.exception) == "--port: it is --listen HOST:PORT here: --listen 127.0.0.1:8080"
