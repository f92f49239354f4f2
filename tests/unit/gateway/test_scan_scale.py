"""``trade scan --write`` on CiA 402 drives: the file has the scale that each drive reports (S23)."""

import time
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from tests.support.waiting import wait_until
from trade.errors import ConfigurationError
from trade_drivers import attach, parse
from trade_gateway.cli import app
from trade_hil_sim import frames
from trade_hil_sim.cia402 import Cia402Bus, Drive, Object, factor_objects, unit_objects

pytestmark = pytest.mark.virtual_time


def scanned(sim: Cia402Bus, path: Path) -> Result:
    wait_until(lambda: len(frames(sim.log.entries, "boot_up")) == len(sim.devices), "all have booted")
    words = ("scan", "--port", sim.port, "--driver", "cia402", "--ids", "1-2", "--write", str(path))
    return CliRunner().invoke(app, words)


def drives(*objects: Object) -> Cia402Bus:
    now = time.monotonic()
    made = [Drive(1, counts_per_rev=16384, t=now), Drive(2, t=now)]
    made[0].says(*objects)
    return Cia402Bus(made)


@pytest.mark.parametrize(
    ("objects", "counts_per_rev"),
    [
        ([], 4096),
        (factor_objects(encoder=(16384, 1)), 16384),
        (factor_objects(encoder=(131072, 1), gear_ratio=(7, 3), feed=(36000, 1)), 36000 * 3 / 7),
        (unit_objects(position=0xFD410000), 360000),
    ],
    ids=["says nothing", "encoder", "feed", "angle"],
)
def test_S23_a_scan_writes_the_scale_that_a_drive_reports_and_the_driver_accepts_it(
    tmp_path: Path, objects: list[Object], counts_per_rev: float
) -> None:
    with drives(*objects) as sim:
        said = scanned(sim, tmp_path / "legs.toml")
        assert said.exit_code == 0, said.output
        text = (tmp_path / "legs.toml").read_text(encoding="utf-8")
        robot = parse(text, "legs.toml")
        assert [joint.counts_per_rev for joint in robot.joints] == pytest.approx([counts_per_rev, 4096], rel=1e-9)
        assert ("as the drive says" in text) == bool(objects)
        assert not [frame for frame in frames(sim.log.entries, "sdo_request") if frame.data[0] & 0xE0 == 0x20]
        attach(robot, announced=False).close()


def test_S23_no_file_is_written_for_a_drive_whose_scale_is_impossible(tmp_path: Path) -> None:
    with drives(*factor_objects(encoder=(16384, 0))) as sim:
        error = scanned(sim, tmp_path / "legs.toml").exception
    assert isinstance(error, ConfigurationError)
    assert "its scale is impossible: 608Fh = 16384/0" in str(error)
    assert not (tmp_path / "legs.toml").exists()
