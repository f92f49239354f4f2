"""``trade rules``: run a file, try one out, list the active rules."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.support.waiting import wait_until
from trade import Container, service, where
from trade.errors import ConfigurationError
from trade_gateway.cli import app

pytestmark = pytest.mark.virtual_time

StartContainer = Callable[..., Container]

FILE = """
[rule.greet]
when = { joined = { name = "switch" } }
do = [{ call = { name = "note" }, args = ["$service"] }]

[rule.alone]
when = { missing = { name = "dance" } }
if = { service = { name = "is_dark" } }
do = [{ call = { name = "note" }, args = [7] }, { call = { name = "missing" } }]
cooldown_s = 600
"""


class Desk:
    def __init__(self) -> None:
        self.noted: list[Any] = []

    @service
    def note(self, what: Any) -> None:
        self.noted.append(what)

    @service(effect="read")
    def is_dark(self) -> bool:
        return True


class Lamp:
    @service
    def switch(self) -> None: ...


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "rules.toml"
    path.write_text(FILE)
    return path


@pytest.fixture
def desk(start_container: StartContainer) -> Desk:
    desk = Desk()
    start_container("desk").register(desk, "desk")
    return desk


@pytest.fixture
def run(desk: Desk, file: Path) -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    """Runs the rules in a process of their own; returns it when it is ready."""
    processes: list[subprocess.Popen[str]] = []

    def start(*words: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "trade_gateway", "rules", "run", str(file), "--json", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        assert message(process)["rules"] == ["alone", "greet"]
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate(timeout=60)


def message(process: "subprocess.Popen[str]") -> dict[str, Any]:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, "it ended"
    return json.loads(line)


def trade(*words: str) -> Any:
    return CliRunner().invoke(app, list(words))


@pytest.mark.realtime
def test_rules_run_report_their_firings_are_listed_and_leave(
    run: Callable[..., Any], desk: Desk, file: Path, start_container: StartContainer
) -> None:
    audit = file.parent / "audit.jsonl"
    running = run("--audit", str(audit))
    fired = message(running)
    assert (fired["rule"], [bool(did["error"]) for did in fired["steps"]]) == ("alone", [False, True])
    assert desk.noted == [7]
    start_container("hall").register(Lamp(), "hall")
    assert message(running)["service"] == "hall.switch"
    assert [json.loads(line)["rule"] for line in audit.read_text().splitlines()] == ["alone", "greet"]
    listed = {info["name"]: info for info in json.loads(trade("rules", "list", "--json").stdout)}
    assert (listed["alone"]["fired"], listed["alone"]["failed"], listed["greet"]["container"]) == (1, 1, "rules")
    assert "joined name='switch'" in trade("rules", "list").stdout
    running.send_signal(signal.SIGTERM)
    assert running.wait(60) == 0


@pytest.mark.realtime
def test_a_changed_file_counts_and_a_wrong_one_does_not(run: Callable[..., Any], file: Path) -> None:
    running = run()
    assert message(running)["rule"] == "alone"
    file.write_text("[rule.x]\n")
    assert running.stderr is not None
    wrong = next(line for line in running.stderr if "warning" in line)  # before it: what failed in the first firing
    assert "was changed and has an error; continuing as before" in wrong
    file.write_text(FILE.replace("greet", "welcome"))
    assert message(running) == {"reloaded": str(file)}
    assert {info["name"] for info in json.loads(trade("rules", "list", "--json").stdout)} == {"alone", "welcome"}
    running.send_signal(signal.SIGHUP)
    assert message(running) == {"reloaded": str(file)}


@pytest.mark.realtime
def test_a_dry_run_calls_nothing(run: Callable[..., Any], desk: Desk) -> None:
    fired = message(run("--dry-run"))
    assert (fired["rule"], fired["dry_run"], fired["steps"][0]["result"]) == ("alone", True, "would be called")
    assert desk.noted == []


def test_a_file_is_tried_out_without_calling_anything(desk: Desk, file: Path) -> None:
    said = trade("rules", "test", str(file))
    text = re.sub(r"\s+", " ", said.stdout)
    assert "greet: joined name='switch': would not fire now (nothing matches)" in text
    assert "alone: missing name='dance', if the service with name='is_dark': would fire now" in text
    assert "call name='note': desk.note in desk: would be called" in text
    assert "NoSuchService: no service matches name='missing'" in text
    reported = json.loads(trade("rules", "test", str(file), "--json").stdout)
    assert [(one["rule"], one["fires"]) for one in reported] == [("greet", False), ("alone", True)]
    assert desk.noted == []


def test_a_wrong_file_is_said_before_anything_is_done(file: Path, system: str) -> None:
    file.write_text("[rule.x]\n")
    for command in ("test", "run"):
        said = trade("rules", command, str(file))
        assert isinstance(said.exception, ConfigurationError)
        assert "rule.x: when is missing" in str(said.exception)


def test_an_empty_list_of_rules_is_reported(desk: Desk) -> None:
    assert "no rules run" in trade("rules", "list").stdout
    assert json.loads(trade("rules", "list", "--json").stdout) == []


@pytest.mark.realtime
def test_nothing_is_left_of_rules_that_have_ended(run: Callable[..., Any], start_container: StartContainer) -> None:
    running, looker = run(), start_container("looker")
    looker.find(where(group="rules", name="rules"), wait_s=20)
    running.send_signal(signal.SIGTERM)
    assert running.wait(60) == 0
    wait_until(lambda: looker.services(where(group="rules")) == [])
