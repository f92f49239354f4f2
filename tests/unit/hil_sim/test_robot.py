"""From a robot file to simulated buses."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from trade_hil_sim import DynamixelBus, SimulationError
from trade_hil_sim.robot._robot import buses_of, find_simulator
from trade_robotfile import load

pytestmark = pytest.mark.virtual_time


def test_each_joint_is_a_servo_at_the_joints_zero(robot_file: Path, tmp_path: Path) -> None:
    neck, arm = buses_of(load(robot_file), tmp_path)
    pan, tilt = neck.state().devices
    [elbow] = arm.state().devices
    assert (pan.joint, pan.device_id, pan.model) == ("neck.pan", 1, "XL430-W250")
    assert pan.position_counts == 2048
    # reversed, and its centre is at 0.5 rad: the zero lies on the other side
    assert tilt.position_counts == 2374
    assert tilt.position_rad == pytest.approx(0.0, abs=1e-3)
    # zero is out of its limits: as near as they allow
    assert elbow.position_rad == pytest.approx(0.25, abs=1e-3)
    assert elbow.model == "XM430-W350"


def test_some_buses_can_be_picked(robot_file: Path, tmp_path: Path) -> None:
    assert [bus.name for bus in buses_of(load(robot_file), tmp_path, names=["arm"])] == ["arm"]
    with pytest.raises(SimulationError, match="has no bus 'leg'; it has arm, neck"):
        buses_of(load(robot_file), tmp_path, names=["leg"])


def test_a_model_that_is_not_simulated_is_named_with_those_that_are(robot_file: Path, tmp_path: Path) -> None:
    robot_file.write_text(robot_file.read_text().replace("XM430-W350", "AX-12A"))
    with pytest.raises(
        SimulationError, match=r'joint\."elbow"\.model: .AX-12A. is not simulated; there is .*XL430-W250'
    ):
        buses_of(load(robot_file), tmp_path)


def test_a_baud_rate_the_servo_has_not_got_is_named(robot_file: Path, tmp_path: Path) -> None:
    robot_file.write_text(robot_file.read_text().replace("57600", "38400"))
    with pytest.raises(SimulationError, match=r"bus\.arm\.baud: 38400 is no rate"):
        buses_of(load(robot_file), tmp_path)


def test_simulators_are_found_by_entry_point() -> None:
    assert find_simulator("dynamixel") is DynamixelBus
    with pytest.raises(SimulationError, match=r"nothing simulates driver 'acme'; simulated are: .*dynamixel"):
        find_simulator("acme")


def test_two_simulators_of_one_name_are_an_error_that_names_both() -> None:
    installed = [EntryPoint("x", value, "trade.sims") for value in ("one:Bus", "two:Bus")]
    with pytest.raises(SimulationError, match="two simulators are named 'x': one:Bus and two:Bus"):
        find_simulator("x", installed)
