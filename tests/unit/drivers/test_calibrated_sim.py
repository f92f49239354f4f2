"""The simulator of a robot file is the robot that the file means: homing offset, firmware and serial number."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import dynamixel_sdk  # noqa: F401 - virtual time misses its first import
import pytest

from tests.support.simulated_robots import HEAD, TAIL
from tests.support.waiting import wait_until
from tests.unit.drivers.motor_rig import DAMIAO, ODRIVE
from trade.errors import DeviceSilent, WrongDevice
from trade_drivers import AttachedRobot, Robot, attach, parse
from trade_hil_sim import BrownOut, SimulationError, events, motion_writes
from trade_hil_sim.robot._robot import buses_of

pytestmark = pytest.mark.virtual_time

FILES = {
    "dynamixel": (HEAD, 'homing_counts = -120\nfirmware = "46"'),
    "feetech": (TAIL, 'homing_counts = -120\nfirmware = "3.9"'),
    "damiao": (DAMIAO, 'firmware = "5021"'),
    "odrive": (ODRIVE, 'firmware = "0.6.9"'),
}
"""A robot file of each vendor, and what `trade scan` and `trade calibrate` write into it for a real device."""


def made(text: str, keys: str) -> Robot:
    """The robot of a file whose device 1 has these keys."""
    assert "id = 1\n" in text
    return parse(text.replace("id = 1\n", f"id = 1\n{keys}\n", 1), "one.toml")


class Twin:
    """The simulation of one robot file, and a driver of another one on it."""

    def __init__(self, folder: Path, undo: ExitStack) -> None:
        self._folder, self._undo = folder, undo

    def plug(self, robot: Robot) -> Any:
        [sim] = buses_of(robot, self._folder, paced=False)
        self.sim: Any = sim
        return self._undo.enter_context(self.sim)

    def attach(self, robot: Robot) -> AttachedRobot:
        ports = {robot.buses[0].name: str(self.sim.port)}
        attached = attach(robot, ports=ports, announced=False)
        self._undo.callback(attached.close)
        return attached

    def truth(self) -> Any:
        return next(device for device in self.sim.state().devices if device.device_id == 1)


@pytest.fixture
def twin(tmp_path: Path) -> Any:
    with ExitStack() as undo:
        yield Twin(tmp_path, undo)


@pytest.mark.parametrize("vendor", FILES)
def test_a_calibrated_robot_works_on_its_own_simulator(twin: Twin, vendor: str) -> None:
    robot = made(*FILES[vendor])
    twin.plug(robot)
    motor = twin.attach(robot).motor(robot.joints[0].name)
    assert motor.state().position_rad == pytest.approx(0.0, abs=2e-3)
    motor.enable()
    motor.move_to(0.3)
    assert twin.truth().position_rad == pytest.approx(0.3, abs=5e-3)


@pytest.mark.parametrize("vendor", FILES)
def test_a_calibrated_robot_is_refused_on_another_one(twin: Twin, vendor: str) -> None:
    text, keys = FILES[vendor]
    twin.plug(parse(text, "one.toml"))
    with pytest.raises(WrongDevice):
        twin.attach(made(text, keys))
    assert not motion_writes(list(twin.sim.log.entries), device_id=1)


@pytest.mark.parametrize("vendor", ["dynamixel", "feetech"])
def test_a_simulated_servo_keeps_its_calibration_without_power(twin: Twin, vendor: str) -> None:
    robot = made(*FILES[vendor])
    sim = twin.plug(robot)
    motor = twin.attach(robot).motor(robot.joints[0].name)
    sim.do(BrownOut(ids=(1,)))
    wait_until(lambda: events(list(sim.log.entries), "booted", device_id=1), "it has booted")

    def answers() -> bool:
        try:
            motor.state()
        except DeviceSilent:
            return False
        return True

    wait_until(answers, "it answers")
    motor.enable()
    motor.move_to(0.3)
    assert twin.truth().position_rad == pytest.approx(0.3, abs=5e-3)


@pytest.mark.parametrize(
    ("vendor", "keys", "says"),
    [
        ("feetech", "homing_counts = 3000", "homing_counts: 3000 does not fit into an STS3215"),
        ("feetech", 'firmware = "3"', "firmware: '3' has not the form N.N"),
        ("dynamixel", 'firmware = "v46"', "firmware: 'v46' has not the form N"),
        ("odrive", 'firmware = "0.6"', "firmware: '0.6' has not the form N.N.N"),
        ("damiao", 'firmware = "5.21"', "firmware: '5.21' is no number"),
    ],
)
def test_what_no_such_device_can_have_is_not_simulated(twin: Twin, vendor: str, keys: str, says: str) -> None:
    with pytest.raises(SimulationError, match=says):
        twin.plug(made(FILES[vendor][0], keys))
