"""``trade policy``: what it says and the exit codes that programs go by."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.support.policies import policy_text
from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.cli import app

POLICY = policy_text(
    "planner=operator dash-*=viewer thief=operator",
    head='revoked = ["thief"]\n',
    viewer="read=*",
    operator="includes=viewer call=rosie.neck",
)


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    path = tmp_path / "policy.toml"
    path.write_text(POLICY)
    return path


def run(*words: str, env: dict[str, str] | None = None) -> Any:
    return CliRunner().invoke(app, ["policy", *words], env=env or {"TRADE_POLICY": ""})


CHECKS = [
    ("planner", "call", "rosie.neck.move_to", 0, "allowed: role operator: call rosie.neck"),
    ("planner", "call", "rosie", 1, "denied: no rule of role operator allows call in rosie"),
    ("dash-1", "read", "_", 0, "allowed: role viewer: read *"),
    ("thief", "read", "rosie", 1, "denied: thief is revoked"),
    ("dash-1", "call", "trade.clock", 0, "allowed: every identity may"),
    ("dash-1", "call", "trade.connect", 1, "denied: no rule of role viewer allows administer in trade"),
    ("dash-1", "lock", "trade.clock", 1, "denied: no rule of role viewer allows lock in trade.clock"),
]


@pytest.mark.parametrize(("who", "verb", "what", "code", "said"), CHECKS)
def test_a_check_says_the_rule_and_ends_with_it(
    policy: Path, who: str, verb: str, what: str, code: int, said: str
) -> None:
    ended = run("check", who, verb, what, "--policy", str(policy))
    assert (ended.exit_code, ended.stdout.strip()) == (code, said)


def test_a_check_in_json_is_one_line(policy: Path) -> None:
    ended = run("check", "planner", "call", "rosie", "--json", env={"TRADE_POLICY": str(policy)})
    assert ended.exit_code == 1
    assert json.loads(ended.stdout) == {"allowed": False, "rule": "no rule of role operator allows call in rosie"}


def test_wrong_words_are_usage_errors_and_a_wrong_file_is_none(policy: Path) -> None:
    assert isinstance(run("check", "planner", "call", "rosie").exception, UsageError)
    assert isinstance(run("check", "planner", "calls", "x", "--policy", str(policy)).exception, UsageError)
    policy.write_text("[roles]\n")
    wrong = run("show", "--policy", str(policy)).exception
    assert isinstance(wrong, ConfigurationError)
    assert not isinstance(wrong, UsageError)


def test_show_lists_identities_with_what_they_may(policy: Path) -> None:
    shown = json.loads(run("show", "--policy", str(policy), "--json").stdout)
    assert shown["revoked"] == ["thief"]
    assert shown["identities"]["planner"]["roles"] == ["operator"]
    assert shown["identities"]["planner"]["call"] == ["rosie.neck"]
    assert shown["identities"]["dash-*"]["read"] == ["*"]
    assert shown["identities"]["thief"]["call"] == []
    table = re.sub(r" +", " ", run("show", "--policy", str(policy)).stdout)
    assert "planner operator rosie.neck *" in table
    assert "revoked: thief" in table
