"""``trade stop``: what it stops, what it says, and how it ends."""

import json
import subprocess
from collections.abc import Callable

import pytest

from tests.support.waiting import wait_until
from tests.system.conftest import Rosie
from trade import Container, where
from trade.errors import MotionStopped
from trade_hil_sim import events, read_log

pytestmark = pytest.mark.slow

Command = Callable[..., "subprocess.CompletedProcess[str]"]
PAN = where(group="rosie.neck.pan", name="move_to")


def test_S07_it_stops_what_moves_in_a_group_and_says_what(
    rosie_up: Callable[[], Rosie], start_container: Callable[..., Container], trade_command: Command
) -> None:
    rosie, mover = rosie_up(), start_container("mover")
    moving = mover.find(PAN, wait_s=30).with_(deadline_s=120).start(1.3, 0.1)
    wait_until(lambda: bool(events(read_log(rosie.log), "motion_started", device_id=1)))
    said = trade_command("stop", "rosie.neck", "--reason", "smoke")
    assert said.returncode == 0, said.stderr
    assert "stopped: rosie.neck.pan.stop" in said.stdout
    with pytest.raises(MotionStopped):
        moving.result(60)
    said = trade_command("stop", "rosie.neck", "--json")
    assert "rosie.neck.pan.stop" in json.loads(said.stdout)["stopped"]


def test_nothing_to_stop_ends_with_1(system: str, trade_command: Command) -> None:
    said = trade_command("stop", "rosie.neck", "--limit", "0.2")
    assert said.returncode == 1
    assert f"nothing was found in group rosie.neck of system {system}" in " ".join(said.stdout.split())
    assert trade_command("stop", "rosie neck", "--limit", "0.2").returncode != 0
