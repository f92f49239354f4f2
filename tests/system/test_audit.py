"""The record of a robot that runs in a process of its own, as the command line shows and checks it."""

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.system.conftest import Rosie
from trade import Container, where
from trade.errors import AccessDenied, InvalidArgument, LockedByOther, Stopped

pytestmark = pytest.mark.slow

Command = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def rosie(rosie_up: Callable[[], Rosie], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rosie:
    policy = tmp_path / "policy.toml"
    policy.write_text(
        """
[roles.all]
read = ["*"]
call = ["*"]
lock = ["*"]
register = ["*"]
administer = ["rosie"]
[identities]
"*" = ["all"]
"""
    )
    with monkeypatch.context() as patched:
        patched.setenv("TRADE_AUDIT", str(tmp_path / "audit"))
        patched.setenv("TRADE_POLICY", str(policy))
        return rosie_up()


def reported(trade_command: Command, folder: Path, *words: str) -> list[dict[str, Any]]:
    done = trade_command("audit", folder, "--json", *words)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_the_record_has_calls_locks_stops_and_refusals_with_client_and_reason(
    rosie: Rosie, start_container: Callable[..., Container], trade_command: Command, tmp_path: Path
) -> None:
    folder = tmp_path / "audit"
    anna, berta = start_container("anna"), start_container("berta")
    moves = [one.find(where(name="move_to", group="rosie.neck.pan"), wait_s=30) for one in (anna, berta)]
    with anna.lock(where(group="rosie.neck"), purpose="looking"):
        moves[0](0.2)
        with pytest.raises(LockedByOther):
            moves[1](0.3)
    with pytest.raises(InvalidArgument):
        moves[1]("far")
    with pytest.raises(AccessDenied):
        anna.call(where(name="set_tracing", group="trade", container="rosie"), True)
    report = berta.estop("the door")
    assert report.complete
    with pytest.raises(Stopped):
        moves[0](0.1)

    def complete() -> bool:
        return len(reported(trade_command, folder, "--kind", "refused")) == 4

    wait_until(complete)
    refused = reported(trade_command, folder, "--kind", "refused", "--container", "rosie")
    assert [(row["what"], row["outcome"]) for row in refused] == [
        ("rosie.neck.pan.move_to", "LockedByOther"),
        ("rosie.neck.pan.move_to", "InvalidArgument"),
        ("trade.set_tracing", "AccessDenied"),
        ("rosie.neck.pan.move_to", "Stopped"),
    ]
    assert [row["session"] for row in refused] == [str(one.address) for one in (berta, berta, anna, anna)]
    assert "looking" in refused[0]["why"]
    assert "instrument" in refused[2]["why"]
    assert "the door" in refused[3]["why"]
    [called] = reported(trade_command, folder, "--service", "*.move_to", "--kind", "call")
    assert (called["session"], called["outcome"]) == (str(anna.address), "ok")
    locks = reported(trade_command, folder, "--kind", "lock")
    assert [row["what"] for row in locks] == ["locked", "unlocked"]
    assert "rosie.neck.pan" in locks[0]["about"]
    [estop] = reported(trade_command, folder, "--service", "e-stop")
    assert (estop["session"], estop["why"]) == (str(berta.address), "the door")


def test_a_killed_robot_leaves_a_verifiable_audit_record_that_the_next_boot_continues(
    rosie: Rosie,
    rosie_up: Callable[[], Rosie],
    start_container: Callable[..., Container],
    trade_command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "audit"
    start_container("anna").find(where(name="stop", group="rosie.neck.pan"), wait_s=30)()
    wait_until(lambda: bool(reported(trade_command, folder, "--kind", "stop")))
    rosie.program.signal(signal.SIGKILL)
    rosie.program.wait()
    assert trade_command("audit", "verify", folder).returncode == 0
    monkeypatch.setenv("TRADE_AUDIT", str(folder))
    again = rosie_up()
    again.program.signal(signal.SIGTERM)
    assert again.program.wait() == 0
    rows = reported(trade_command, folder, "--container", "rosie", "--kind", "audit")
    assert [row["what"] for row in rows] == ["began", "began", "ended"]
    assert trade_command("audit", "verify").returncode == 0
