"""``trade drill``: what a moving robot hangs on is taken away for real, and a limit that is not kept is named."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.system.conftest import ROSIES_HEAD

_SECONDS = 500
"""A drill starts a dozen processes, one after the other."""

pytestmark = [pytest.mark.timeout(_SECONDS + 60)]


def _drill(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "trade_gateway", "drill", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)


def _verdicts(report: dict[str, Any]) -> dict[str, list[str]]:
    return {scene["scene"]: [stop["verdict"] for stop in scene["stops"]] for scene in report["scenes"]}


def test_a_robot_that_stops_in_time_passes_and_the_report_is_written(tmp_path: Path) -> None:
    words = ("--only", "partition", "--only", "driver_killed", "--only", "gateway_killed")
    drilled = _drill(ROSIES_HEAD, *words, "--report", tmp_path, "--json")
    assert drilled.returncode == 0, drilled.stdout + drilled.stderr
    report = json.loads(drilled.stdout)
    assert _verdicts(report) == {"gateway_killed": ["ok"], "partition": ["ok"], "driver_killed": ["ok"]}
    assert json.loads((tmp_path / "drill.json").read_text()) == report
    assert "neck.pan" in (tmp_path / "drill.html").read_text()
    took = {scene["scene"]: scene["stops"][0]["took_s"] for scene in report["scenes"]}
    assert took["driver_killed"] < took["partition"]  # the servo's watchdog does not wait for the lease


def test_a_limit_that_is_exceeded_fails_the_drill_and_is_named(tmp_path: Path) -> None:
    copy = tmp_path / "head.toml"
    copy.write_text(f"{ROSIES_HEAD.read_text()}\n[drill]\nstream_frozen = 0.001\n")
    drilled = _drill(copy, "--only", "stream_frozen", "--only", "unplug")
    assert drilled.returncode == 1, drilled.stdout + drilled.stderr
    assert drilled.stdout.splitlines()[-1] == "failed: stream_frozen: neck.pan too long"
    assert drilled.stdout.count("  ok") == 1  # unplugging kept its own limit
