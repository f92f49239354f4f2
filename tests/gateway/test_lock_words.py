"""The words of ``trade lock`` and its kind: help with examples, and what follows two dashes is left as it is."""

import re

import pytest
from typer.testing import CliRunner

from trade_gateway.cli import app
from trade_gateway.commands._lock import _wanted
from trade_gateway.commands._output import UsageError


@pytest.mark.parametrize("command", ["lock", "locks", "unlock", "resume", "estop"])
def test_help_has_an_example(command: str) -> None:
    said = CliRunner().invoke(app, [command, "--help"])
    assert said.exit_code == 0
    assert f"For example: trade {command}" in re.sub(r"\s+", " ", said.stdout)


def test_the_usage_says_where_the_command_goes() -> None:
    said = CliRunner().invoke(app, ["lock", "--help"])
    assert "-- COMMAND [ARGUMENT]..." in said.stdout


def test_options_of_the_command_are_its_own_and_those_before_the_dashes_are_ours() -> None:
    assert CliRunner().invoke(app, ["lock", "--no-such", "--", "true"]).exit_code == 2
    said = CliRunner().invoke(app, ["lock", "--", "true", "--help", "--no-such"])
    assert isinstance(said.exception, UsageError)  # none of ours: nothing to lock is what is wrong
    assert "say what to lock" in str(said.exception)


def test_names_are_alternatives_within_the_group() -> None:
    assert str(_wanted("rosie", ["move_to", "enable"])).count("rosie") == 2
    with pytest.raises(UsageError, match="say what to lock"):
        _wanted(None, [])
