"""The plug-in for pytest with `simulated_robot`, as a user runs it."""

import re
from pathlib import Path

import psutil
import pytest

from tests.support.pytest_runs import run_pytest
from tests.support.simulated_robots import HEAD

PATIENT = HEAD.replace('driver = "dynamixel"', 'driver = "dynamixel"\nstale_after_s = 2\nwatchdog_s = 2')

PAGE = Path(__file__).parents[3] / "docs" / "testing.md"

ENDS = """
from pathlib import Path
import pytest
from trade import errors

def test_the_simulator_ends(simulated_robot):
    robot = simulated_robot("head.toml")
    Path("sim.pid").write_text(str(robot.sim.pid))
    Path("sim.log").write_text(str(robot.sim.log_path))
    assert robot.attached.group("head").joints() == ["rosie.neck.pan", "rosie.neck.tilt"]
    assert robot.container.name == "rosie"

def test_a_missing_file_is_named(simulated_robot):
    with pytest.raises(errors.ConfigurationError, match="feet.toml: there is no such robot file in"):
        simulated_robot("feet.toml")
"""


@pytest.mark.realtime
def test_the_example_of_the_page_does_what_it_says(tmp_path: Path, system: str) -> None:
    [program] = re.findall(r'```python title="test_look.py"\n(.*?)```', PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "head.toml").write_text(PATIENT)
    assert "4 passed" in run_pytest(tmp_path, program)


@pytest.mark.realtime
def test_a_simulator_ends_with_its_test_and_leaves_its_log(tmp_path: Path, system: str) -> None:
    (tmp_path / "head.toml").write_text(PATIENT)
    assert "2 passed" in run_pytest(tmp_path, ENDS)
    assert not psutil.pid_exists(int((tmp_path / "sim.pid").read_text()))
    assert Path((tmp_path / "sim.log").read_text()).stat().st_size > 0
