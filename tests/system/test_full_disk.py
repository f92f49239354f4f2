"""A full disk, on which all lies that a robot's host keeps: what has to stop stops, and nothing is half there."""

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.full_disks import SmallDisk, small_disk
from tests.support.waiting import wait_until
from tests.system.conftest import Rosie
from trade import CallModel, Container, where
from trade.errors import ConfigurationError, MotionStopped, Stopped
from trade_gateway.cli.hardware._calibrate import _write
from trade_gateway.cli.watching._profile import read, write
from trade_gateway.http import add_token
from trade_gateway.pki._authority import Authority
from trade_gateway.terminal._output import Output
from trade_hil_sim import events, read_log

Command = Callable[..., "subprocess.CompletedProcess[str]"]
PAN = where(group="rosie.neck.pan", name="move_to")


@pytest.fixture
def disk(system: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SmallDisk]:
    """With the folders in which containers find each other, and keep what outlives them."""
    with small_disk(tmp_path / "disk") as made:
        for what in ("RUNTIME_DIR", "STATE_DIR", "AUDIT"):
            monkeypatch.setenv(f"TRADE_{what}", str(made.folder / what.lower()))
        yield made


def kept(disk: SmallDisk, system: str) -> list[str]:
    """What is kept of e-stops."""
    return sorted(path.name for path in (disk.folder / "state_dir" / system / "estop").rglob("*.json"))


def test_S09_an_estop_stops_all_and_says_that_it_is_not_written_down(
    disk: SmallDisk,
    system: str,
    rosie_up: Callable[[], Rosie],
    start_container: Callable[..., Container],
    trade_command: Command,
) -> None:
    rosie, mover = rosie_up(), start_container("mover")
    move = mover.find(PAN, wait_s=30).with_(deadline_s=120)
    moving = move.start(1.3, 0.1)
    wait_until(lambda: bool(events(read_log(rosie.log), "motion_started", device_id=1)))
    disk.fill()
    said = trade_command("estop", "--reason", "smoke", "--json")
    assert said.returncode == 1, said.stderr
    [(_, problem)] = json.loads(said.stdout)["failed"].items()
    assert "is not written down and will not outlive this process" in problem
    with pytest.raises(MotionStopped):
        moving.result(60)
    with pytest.raises(Stopped, match="smoke"):
        move(0.1)
    assert kept(disk, system) == []
    cleared = trade_command("estop", "--clear", "--json")
    assert cleared.returncode == 0, cleared.stderr
    disk.make_room()
    again = trade_command("estop", "--json")
    assert again.returncode == 0, again.stderr
    assert kept(disk, system) == [f"{json.loads(again.stdout)['id']}.json"]


def test_a_container_started_on_a_full_disk_works_is_found_and_keeps_its_record_later(
    disk: SmallDisk,
    rosie_up: Callable[[], Rosie],
    start_container: Callable[..., Container],
    trade_command: Command,
) -> None:
    first = start_container("first")
    disk.fill()
    rosie = rosie_up()
    assert first.find(PAN, wait_s=30)(0.2) == pytest.approx(0.2, abs=0.02)
    assert start_container("late").find(PAN, wait_s=30)(0.1) == pytest.approx(0.1, abs=0.02)
    wait_until(lambda: "audit: " in "".join(rosie.program.errors))
    assert "may not find this one" in "".join(rosie.program.errors)
    disk.make_room()

    def rows(*words: str) -> list[dict[str, Any]]:
        return [json.loads(row) for row in trade_command("audit", "--json", *words).stdout.splitlines()]

    moved = ("--container", "rosie", "--service", "*.move_to")
    wait_until(lambda: sum(row["outcome"] == "ok" for row in rows(*moved)) == 2, "its moves are written")
    wait_until(lambda: {row["container"] for row in rows()} == {"first", "late", "rosie"}, "all records are written")
    assert trade_command("audit", "verify").returncode == 0


def test_an_authority_that_cannot_be_written_is_none_and_can_be_made_later(disk: SmallDisk) -> None:
    disk.fill()
    with pytest.raises(OSError, match="space"):
        Authority.create(disk.folder / "pki")
    disk.make_room()
    assert Authority.create(disk.folder / "pki").issue("rosie").name == "rosie"


def test_a_robot_file_is_as_it_was(disk: SmallDisk) -> None:
    file = disk.folder / "rosie.toml"
    file.write_text("zero_counts = 2048\n")
    disk.fill()
    before = sorted(disk.folder.iterdir())
    with pytest.raises(ConfigurationError, match="it is unchanged"):
        _write(Output(as_json=True), file, b"zero_counts = 2048\n", "zero_counts = 2050\n", yes=True)
    assert file.read_text() == "zero_counts = 2048\n"
    assert sorted(disk.folder.iterdir()) == before


def test_an_earlier_learned_model_stays(disk: SmallDisk) -> None:
    file = disk.folder / "usual.json"
    learned = CallModel(v=1, after={"look": {"grip": 2}})
    write(file, learned)
    disk.fill()
    with pytest.raises(ConfigurationError):
        write(file, CallModel(v=1, after={}))
    assert read(file) == learned


def test_tokens_stay_as_they_were(disk: SmallDisk) -> None:
    file = disk.folder / "tokens.toml"
    add_token(file, "anna")
    before = file.read_text()
    disk.fill()
    with pytest.raises(ConfigurationError, match="cannot be written"):
        add_token(file, "berta")
    assert file.read_text() == before
