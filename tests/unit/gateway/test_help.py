"""What ``trade --help`` promises: each command has an example, and shells can complete its words."""

import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from trade_gateway.cli import build


def _leaves(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Commands that do something themselves."""
    for word, inner in getattr(command, "commands", {}).items():
        yield from _leaves(inner, f"{name} {word}")
    if not getattr(command, "commands", {}) or command.invoke_without_command:
        yield name, command


COMMANDS = dict(_leaves(typer.main.get_command(build()), "trade"))
COMMANDS.pop("trade", None)


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_has_an_example_of_itself(name: str) -> None:
    _, found, example = (COMMANDS[name].help or "").partition("For example: ")
    assert found, f"the docstring of {name} has no line 'For example: {name} ...'"
    assert " ".join(name.split()[:2]) in example


@pytest.mark.parametrize(
    ("words", "expected", "other"),
    [("trade lo", {"lock", "locks", "logs"}, "up"), ("trade stream --h", {"--hz", "--help"}, "--json")],
)
def test_words_are_completed(words: str, expected: set[str], other: str) -> None:
    asked = {"_TRADE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    told = subprocess.run(
        [sys.executable, "-c", "import sys; sys.argv[0] = 'trade'; from trade_gateway.cli import main; main()"],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert expected <= set(told)
    assert other not in told
