"""One robot's fault is looked into with another robot's camera, as shipped: five processes and a rule."""

import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.conftest import DORA, ROOT, Program
from trade import Container, where
from trade_hil_sim import LogEntry, SimControl, events, read_log

EXAMPLES = ROOT / "examples"
SHOULDER = "dora.right.shoulder"
pytestmark = [pytest.mark.timeout(240)]


def pictures_asked(log: Path, since: float) -> list[LogEntry]:
    return [entry for entry in events(read_log(log), "received", since=since) if entry.bus == "eye"]


def test_a_joint_of_one_robot_fails_and_the_camera_of_another_takes_a_picture(
    run: Callable[..., Program],
    trade_command: Callable[..., subprocess.CompletedProcess[str]],
    start_container: Callable[..., Container],
    tmp_path: Path,
) -> None:
    log, folder = tmp_path / "rosie.jsonl", tmp_path / "pictures"
    dora = run("-m", "trade_gateway", "up", DORA, "--sim", "--json").json()
    rosie = run("-m", "trade_gateway", "up", EXAMPLES / "eye.toml", "--sim", "--sim-log", log, "--json").json()
    assert dora["container"] != rosie["container"]
    witness = run(EXAMPLES / "witness.py", folder)
    assert witness.line() == "ready: witness.look_into\n"
    rules = run("-m", "trade_gateway", "rules", "run", EXAMPLES / "witness.toml", "--json")
    rules.json()

    asker = start_container("asker")
    image = asker.find(where(name="image", group="rosie.eye"), wait_s=30)
    before = image().data
    asker.find(where(name="move_to", group="rosie.neck.pan"), wait_s=30)(0.8)
    struck = time.monotonic()
    assert not pictures_asked(log, struck)
    with SimControl(dora["control"]) as control:
        control.hardware_fault(0x20, [1], bus="right")

    said = witness.line()
    asked = pictures_asked(log, struck)
    assert len(asked) == 1, said
    [picture] = folder.iterdir()
    assert picture.read_bytes() == image().data, "it shows rosie as she is after the fault"
    assert picture.read_bytes() != before
    assert said.startswith(f"{SHOULDER}: hardware error: overload; seen by rosie.eye at 2")

    listed = trade_command("faults", "dora", "--open", "--json")
    [fault] = json.loads(listed.stdout)
    assert (fault["device"], fault["count"]) == (SHOULDER, 1)
    assert [note.endswith(str(picture)) for note in fault["evidence"]] == [True]
    shown = trade_command("faults", "show", fault["id"]).stdout
    assert f"evidence: seen by rosie.eye at 2{fault['evidence'][0].split(' at 2', 1)[1]}" in shown
    assert "position_rad" in shown
    assert "dora.right.shoulder.state" in trade_command("services", "--group", SHOULDER).stdout
    assert "degraded: hardware error: overload" in trade_command("services", "--group", SHOULDER).stdout
    seen = trade_command("faults", "ack", fault["id"])
    assert "seen by" in seen.stdout, seen.stderr

    listed = trade_command("faults")
    assert listed.stdout.splitlines()[0].split()[:5] == ["ID", "DEVICE", "FAULT", "STATE", "COUNT"]
    assert fault["id"] in listed.stdout
    unknown = trade_command("faults", "show", "dora-none")
    assert unknown.returncode == 1
    assert "there is no fault 'dora-none'; `trade faults` lists all faults" in unknown.stderr
