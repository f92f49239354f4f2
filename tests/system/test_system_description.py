"""What `trade system diff` and `trade system snapshot` say of a supervised system, and what they refuse."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import CompletedProcess

import pytest

import trade
from tests.support.waiting import wait_until
from trade import where

Command = Callable[..., CompletedProcess[str]]
LAMP = "from trade import service\nclass Lamp:\n    @service(effect='read')\n    def level(self) -> float: return 1.0\n"


class Home:
    """A supervised lamp and a program, and the commands about their file."""

    def __init__(self, folder: Path, system: str, command: Command) -> None:
        self.folder = folder
        self.file = folder / "system.toml"
        self._command = command
        (folder / "lamp.py").write_text(LAMP)
        (folder / "tool").write_text("#!/bin/sh\nexec sleep 600\n")
        (folder / "tool").chmod(0o755)
        self.file.write_text(
            f'[system]\nname = "{system}"\nsupervisor = "keeper"\n[container."lamp-1"]\n'
            'providers = [{ class = "lamp:Lamp", groups = ["hall"] }]\nrestarts = 3\n'
            '[container.tool]\nprogram = ["./tool"]\nenv = { WORD = "a \\"secret\\"" }\nafter = ["lamp-1"]\n'
        )

    def do(self, verb: str, *words: str | Path) -> CompletedProcess[str]:
        return self._command("system", verb, *words)

    def differences(self, file: Path) -> set[tuple[str, str]]:
        found = json.loads(self.do("diff", file, "--json").stdout)
        return {(one["container"], one["key"]) for one in found}


@pytest.fixture
def home(system: str, tmp_path: Path, trade_command: Command) -> Iterator[Home]:
    made = Home(tmp_path, system, trade_command)
    ended = made.do("up", made.file)
    assert ended.returncode == 0, ended.stderr
    yield made
    made.do("down", made.file)


def test_a_snapshot_is_a_file_without_a_difference_and_a_changed_file_has_them(home: Home) -> None:
    other = home.folder / "elsewhere"
    other.mkdir()
    taken = home.do("snapshot", other / "now.toml")
    assert taken.returncode == 0, taken.stderr
    assert home.differences(other / "now.toml") == set()
    assert home.do("diff", other / "now.toml").returncode == 0
    text = (other / "now.toml").read_text()
    changed = other / "changed.toml"
    changed.write_text(
        text.replace("restarts = 3", "restarts = 4").replace("[container.tool", "[container.instrument")
        + "\n[container.more]\nproviders = []\n"
    )
    assert home.differences(changed) == {
        ("lamp-1", "restarts"),
        ("instrument", ""),
        ("tool", ""),
        ("more", ""),
    }
    changed.write_text(text.replace("secret", "password"))
    said = home.do("diff", changed)
    assert said.returncode == 1
    assert said.stdout == "tool.env: the file has other values of WORD; what runs has other values of WORD\n"


def test_a_container_that_no_supervisor_started_is_named_and_left_out(home: Home, run: Callable[..., object]) -> None:
    stray = "import trade\nclass A:\n    @trade.service\n    def a(self) -> None: ...\ntrade.register(A(), 'stray')\n"
    program = run("-c", f"{stray}print('up', flush=True)\nimport time; time.sleep(600)")
    program.line()
    [handle] = [trade.find(where(name="a", group="stray"), wait_s=30)]
    name = handle.key.address.container
    assert home.differences(home.file) == {(name, "")}
    taken = home.do("snapshot", home.folder / "now.toml")
    assert f"not in the file, since no supervisor of this host started it: {name}" in taken.stderr
    assert f"# Not described, since keeper does not supervise it: {name}" in (home.folder / "now.toml").read_text()


def test_a_snapshot_names_all_files_that_are_gone_and_writes_nothing(home: Home) -> None:
    there = home.folder / "there"
    there.mkdir()
    (home.folder / "tool").rename(home.folder / "moved")
    taken = home.do("snapshot", there / "now.toml")
    assert taken.returncode == 1
    assert f"these files are gone, so nothing was written: container.tool.program: {home.folder}/tool" in taken.stderr
    assert list(there.iterdir()) == []
    (home.folder / "moved").rename(home.folder / "tool")
    (there / "now.toml").write_text("mine")
    assert "exists already" in home.do("snapshot", there / "now.toml").stderr
    assert (there / "now.toml").read_text() == "mine"
    assert home.do("snapshot", there / "now.toml", "--force").returncode == 0
    assert [path.name for path in there.iterdir()] == ["now.toml"]


def test_up_reports_each_state_down_stops_each_and_a_stopped_one_stays_down(home: Home) -> None:
    stop = trade.find(where(name="stop_child"), wait_s=30)
    stop("tool")
    states = lambda: {  # noqa: E731
        one["container"]: one["state"] for one in json.loads(home.do("status", home.file, "--json").stdout)
    }
    wait_until(lambda: states()["tool"].startswith("stopped"), "it has ended")
    assert states()["lamp-1"] == "up"
    trade.find(where(name="restart_child"))("tool")
    wait_until(lambda: states() == {"keeper": "up", "lamp-1": "up", "tool": "up"})
    down = home.do("down", home.file, "--json").stdout.splitlines()
    assert [(json.loads(one)["container"], json.loads(one)["state"]) for one in down] == [
        ("tool", "ended"),
        ("lamp-1", "ended"),
        ("keeper", "ended"),
    ]


def test_a_program_that_always_ends_fails_the_start_with_its_reason_and_takes_all_down(
    system: str, tmp_path: Path, trade_command: Command
) -> None:
    file = tmp_path / "system.toml"
    file.write_text(
        f'[system]\nname = "{system}"\nsupervisor = "keeper"\n[container.a]\nrestarts = 1\n'
        f"program = ['{sys.executable}', '-c', 'exit(\"no map\")']\n"
    )
    ended = trade_command("system", "up", file, "--json")
    states = [(one["container"], one["state"]) for one in map(json.loads, ended.stdout.splitlines())]
    assert ended.returncode == 1
    assert "a was not started on local: it did not come up (ended (exit code 1: no map))" in ended.stderr
    assert states[0] == ("keeper", "started")
    assert {name for name, _ in states} == {"keeper", "a"}
    assert states[-1] == ("keeper", "ended")
