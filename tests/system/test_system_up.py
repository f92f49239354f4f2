"""A whole system from one file: three containers, one of them on another host; what fails, and what comes of it."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

import trade
from tests.support.waiting import wait_until
from tests.system.conftest import ROOT, Program
from tests.system.sshd import Sshd
from trade import where
from trade.errors import LockLost

pytestmark = pytest.mark.slow

Command = Callable[..., subprocess.CompletedProcess[str]]
Run = Callable[..., Program]
TRADE = Path(sys.executable).parent / "trade"


class Deployment:
    """A system file, and the commands about it."""

    def __init__(self, file: Path, system: str, trade_command: Command, sshd: Sshd) -> None:
        self.file = file
        self.system = system
        self._command = trade_command
        self._ssh = ("--ssh-config", sshd.config)

    def say(self, verb: str, *words: str | Path) -> tuple[list[dict], subprocess.CompletedProcess[str]]:
        ssh = self._ssh if verb == "up" else ()
        ended = self._command("system", verb, self.file, *ssh, *words, "--json")
        reported = [json.loads(line) for line in ended.stdout.splitlines()]
        return reported[0] if verb == "status" else reported, ended

    def states(self, verb: str, *words: str | Path) -> dict[str, str]:
        reported, ended = self.say(verb, *words)
        assert ended.returncode == 0 or verb == "status", ended.stderr
        return {one["container"]: one["state"] for one in reported}

    def change(self, before: str, after: str) -> None:
        text = self.file.read_text()
        assert before in text
        self.file.write_text(text.replace(before, after))

    def processes(self) -> list[psutil.Process]:
        """What runs of this system: its id is unique."""
        return [one for one in psutil.process_iter() if _runs_in(one, self.system)]

    def gone(self) -> bool:
        return not self.processes()


def _runs_in(process: psutil.Process, system: str) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE and system in process.cmdline()
    except psutil.Error:
        return False


@pytest.fixture
def home(system: str, tmp_path: Path, sshd: Sshd, trade_command: Command) -> Iterator[Deployment]:
    """A head, simulated, and a lamp here; an eye on another host."""
    (tmp_path / "head.toml").write_text((ROOT / "examples" / "head.toml").read_text())
    (tmp_path / "lamp.py").write_text((ROOT / "examples" / "lamp.py").read_text())
    file = tmp_path / "system.toml"
    file.write_text(
        f'[system]\nname = "{system}"\n'
        '[container.eyes]\nhost = "robot"\nafter = ["rosie"]\n'
        f'command = "{TRADE}"\nproviders = [{{ class = "sight:Eye", groups = ["rosie.eyes"] }}]\n'
        '[container.rosie]\nrobot = "head.toml"\nsim = true\n'
        '[container.lamps]\nafter = ["eyes"]\nproviders = [{ class = "lamp:Lamp", groups = ["hall"], args = [0.5] }]\n'
    )
    deployment = Deployment(file, system, trade_command, sshd)
    yield deployment
    for left in deployment.processes():
        left.terminate()
    wait_until(deployment.gone)


def test_a_system_comes_up_over_its_hosts_in_order_is_left_as_it_is_and_goes_down(home: Deployment) -> None:
    reported, ended = home.say("up")
    assert ended.returncode == 0, ended.stderr
    assert [(one["container"], one["state"]) for one in reported] == [
        ("rosie", "started"),
        ("eyes", "started"),
        ("lamps", "started"),
    ]
    assert trade.find(where(name="see", group="rosie.eyes"), wait_s=30)() == "a cat"
    assert trade.find(where(name="level", group="hall"))() == 0.5
    assert set(home.states("status").values()) == {"up"}

    again, _ = home.say("up")
    assert [one["state"] for one in again] == ["was up"] * 3
    assert [one["pid"] for one in again] == [one["pid"] for one in reported]

    trade.find(where(name="terminate_container", container="eyes"))("it is dark")
    wait_until(lambda: home.states("status") == {"rosie": "up", "eyes": "down", "lamps": "up"})
    assert home.states("up") == {"rosie": "was up", "eyes": "started", "lamps": "was up"}

    assert list(home.states("down").items()) == [("lamps", "ended"), ("eyes", "ended"), ("rosie", "ended")]
    wait_until(home.gone)
    assert home.states("down") == {"lamps": "was down", "eyes": "was down", "rosie": "was down"}


def test_missing_providers_of_a_container_are_made_when_the_system_is_brought_up_again(home: Deployment) -> None:
    home.change('{ class = "lamp:Lamp", groups = ["hall"], args = [0.5] }', "")
    home.change('after = ["eyes"]', 'allow = ["lamp:*"]')
    home.states("up")
    home.change("providers = []", 'providers = [{ class = "lamp:Lamp", groups = ["hall"] }]')
    assert home.states("status")["lamps"] == "lacks lamp:Lamp"
    assert home.states("up") == {"rosie": "was up", "lamps": "started", "eyes": "was up"}
    assert home.states("status")["lamps"] == "up"


def test_a_failed_start_says_why_and_takes_down_what_was_started(home: Deployment) -> None:
    home.change("args = [0.5]", 'args = ["bright", 1]')
    reported, ended = home.say("up")
    assert ended.returncode == 1
    assert "CannotInstantiate" in ended.stderr
    assert "TypeError" in ended.stderr
    states = [(one["container"], one["state"]) for one in reported]
    assert states[2:] == [("lamps", "ended"), ("eyes", "ended"), ("rosie", "ended")]
    assert set(home.states("status").values()) == {"down"}
    wait_until(home.gone)


def test_a_container_that_does_not_start_is_reported_with_the_end_of_its_log(home: Deployment) -> None:
    home.change("sim = true\n", 'after = ["lamps"]\n')
    home.change('after = ["rosie"]\n', "")
    reported, ended = home.say("up", "--keep")
    assert [one["container"] for one in reported] == ["eyes", "lamps"]
    assert "rosie was not started" in ended.stderr
    assert "/dev/serial/by-id" in ended.stderr  # what it said of its port
    assert home.states("status") == {"eyes": "up", "lamps": "up", "rosie": "down"}


def test_a_container_in_use_is_ended_only_by_force(home: Deployment) -> None:
    home.states("up")
    with pytest.raises(LockLost), trade.lock(where(group="rosie.head"), purpose="look", wait_s=30):
        _, ended = home.say("down")
        assert ended.returncode == 1
        assert "is locked by" in ended.stderr
        assert "for 'look'" in ended.stderr
        assert home.states("status")["rosie"] == "up"
        assert home.states("down", "--force")["rosie"] == "ended"


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ('host = "robot"', 'host = "missing.invalid"', "unknown host"),
        (str(TRADE), "/nowhere/trade", "no trade there"),
        (
            'providers = [{ class = "sight:Eye", groups = ["rosie.eyes"] }]',
            'rules = "no.toml"',
            "robot has no readable no.toml",
        ),
    ],
)
def test_a_host_with_a_missing_requirement_is_reported_before_anything_starts(
    home: Deployment, before: str, after: str, said: str
) -> None:
    home.change(before, after)
    reported, ended = home.say("up")
    assert (reported, ended.returncode) == ([], 1)
    assert said in ended.stderr
    assert said in home.say("up", "--check")[1].stderr


def test_a_host_whose_key_is_not_known_gets_nothing_started(home: Deployment, sshd: Sshd) -> None:
    sshd.known_hosts.write_text("")
    reported, ended = home.say("up")
    assert (reported, ended.returncode) == ([], 1)
    assert "unknown host key" in ended.stderr
    assert sshd.known_hosts.read_text() == ""


def test_a_container_that_runs_elsewhere_unseen_is_ended_there(home: Deployment) -> None:
    estranged = home.file.parent / "estranged"
    estranged.write_text(f'#!/bin/sh\nTRADE_CREDENTIALS=other:secret exec "{TRADE}" "$@"\n')
    estranged.chmod(0o755)
    home.change(str(TRADE), str(estranged))
    reported, ended = home.say("up", "--wait", "1")
    assert "not seen" in ended.stderr
    assert [(one["container"], one["state"]) for one in reported[1:]] == [("eyes", "ended"), ("rosie", "ended")]
    wait_until(home.gone)


def test_robots_and_rules_run_on_another_host_and_gateways_here(
    home: Deployment, system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = home.file.parent
    (folder / "care.toml").write_text((ROOT / "examples" / "care.toml").read_text())
    monkeypatch.setenv("TRADE_CREDENTIALS", "a:b")
    laboratory = 'insecure_lan = true\ncredentials = "a:b"\n'
    (folder / "gateway.toml").write_text(
        f'system = "{system}"\nname = "door"\n{laboratory}[share.clinic]\nsystem = "clinic"\ncredentials = "c:d"\n'
    )
    there = folder / "trade"
    there.write_text(f'#!/bin/sh\nTRADE_CREDENTIALS=a:b exec "{TRADE}" "$@"\n')
    there.chmod(0o755)
    far = f'host = "robot"\ncommand = "{there}"\n'
    home.file.write_text(
        f'[system]\nname = "{system}"\n[container.door]\ngateway = "gateway.toml"\n'
        f'[container.rosie]\n{far}robot = "{folder}/head.toml"\nsim = true\n'
        f'[container.care]\n{far}rules = "{folder}/care.toml"\nafter = ["rosie"]\n'
    )
    assert home.states("up") == dict.fromkeys(("door", "rosie", "care"), "started")
    assert home.states("status") == dict.fromkeys(("door", "rosie", "care"), "up")
    assert set(home.states("down").values()) == {"ended"}
    wait_until(home.gone)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_takes_down_what_was_started(
    home: Deployment, sshd: Sshd, run: Run, number: signal.Signals
) -> None:
    words = ("-m", "trade_gateway", "system", "up", home.file, "--ssh-config", sshd.config, "--json")
    up = run(*words)
    assert up.json()["container"] == "rosie"
    up.signal(number)
    up.wait_for(lambda reported: (reported["container"], reported["state"]) == ("rosie", "ended"))
    assert up.wait() != 0
    wait_until(home.gone)


def test_people_read_a_line_for_each_container(home: Deployment, trade_command: Command) -> None:
    home.change('host = "robot"\n', "")
    home.change(f'command = "{TRADE}"\n', "")
    home.change("sight:Eye", "lamp:Lamp")
    said = trade_command("system", "up", home.file).stdout.splitlines()
    assert [re.sub(r"[\d.]+", "N", line) for line in said[:3]] == [
        f"{name}: started after N s, process N" for name in ("rosie", "eyes", "lamps")
    ]
    assert said[3].startswith("system test-")
    assert list(home.states("down").values()) == ["ended"] * 3
