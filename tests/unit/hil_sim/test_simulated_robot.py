"""`simulated_robot`: one text for virtual time, with all in this process, and for the real clock.

`--real-time` runs these tests on the real clock once more.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from pytest_trade_hil_sim.robots import SimulatedRobot, StartRobot, simulated_robot
from tests.support.simulated_robots import HEAD
from tests.support.waiting import wait_until
from trade import Container, errors, where
from trade.testing import MemorySystem, VirtualTime, VirtualTimeError
from trade_hil_sim import SimProcess, SimThreads, SimulationError, events, motion_writes

EXAMPLES = Path(__file__).parents[3] / "examples"

pytestmark = pytest.mark.virtual_time(seed=1)


def _patient(text: str) -> str:
    """With drivers that wait long for simulated devices: on the real clock, a busy computer delays those."""
    return text.replace('driver = "dynamixel"', 'driver = "dynamixel"\nstale_after_s = 2\nwatchdog_s = 2')


@pytest.fixture
def head(tmp_path: Path) -> Path:
    file = tmp_path / "head.toml"
    file.write_text(_patient(HEAD))
    return file


@pytest.fixture
def robot(head: Path, simulated_robot: StartRobot) -> SimulatedRobot:
    return simulated_robot(head)


@pytest.fixture
def mind(robot: SimulatedRobot) -> Container:
    return robot.client("mind")


def test_devices_drivers_containers_and_clients_are_in_one_block(head: Path) -> None:
    before = threading.active_count()
    with simulated_robot(head, log_folder=head.parent) as robot:
        assert isinstance(robot.sim, SimProcess if VirtualTime.current() is None else SimThreads)
        move = robot.client("mind").find(where(name="move_to", group="rosie.head", kind="JointGroup"))
        assert move([0.3, 0.0]) == pytest.approx([0.3, 0.0], abs=0.01)
        assert robot.control.device("neck.pan").position_rad == pytest.approx(0.3, abs=0.01)
        assert motion_writes(robot.log())
    assert not robot.sim.running
    wait_until(lambda: threading.active_count() == before)
    assert motion_writes(robot.sim.entries())
    assert (head.parent / "rosie.jsonl").stat().st_size > 0


@pytest.mark.parametrize("file", ["head", "tail", "legs", "hand", "servo_arm", "eye"])
def test_the_robots_of_the_examples_move(file: str, simulated_robot: StartRobot) -> None:
    robot = simulated_robot(EXAMPLES / f"{file}.toml")
    if robot.attached.robot.grippers:
        hand = robot.attached.gripper("left.hand")
        hand.activate()
        hand.move_to(0.03)
        assert robot.control.gripper("left.hand").width_m == pytest.approx(0.03, abs=0.002)
        return
    joint = robot.attached.robot.joints[0]
    robot.attached.motor(joint.name).move_to(goal_rad := joint.min_rad + 0.4 * (joint.max_rad - joint.min_rad))
    assert robot.control.device(joint.name).position_rad == pytest.approx(goal_rad, abs=0.03)


@pytest.mark.parametrize("file", ["arm", "rosie"])
def test_a_driver_with_a_clock_of_its_own_is_refused_by_name(file: str, trade_system: MemorySystem) -> None:
    if VirtualTime.current() is None:
        pytest.skip("the real clock is as good as its own")
    said = r"toml: bus\.\w+\.driver cannot be on virtual time: driver ur: its library ur-rtde is in C\+\+.*real_clock"
    with pytest.raises(VirtualTimeError, match=said), simulated_robot(EXAMPLES / f"{file}.toml", trade_system):
        pass
    assert trade_system.container("mind").services(where(group="rosie")) == []


def test_a_fault_comes_at_its_time_and_later_ones_end_with_the_robot(head: Path) -> None:
    with simulated_robot(head, log_folder=head.parent) as robot:
        robot.fault_at(2.0, "brown_out ids=1")
        robot.fault_at(3600.0, "unplug")
        time.sleep(1.9)
        assert events(robot.log(), "brown_out") == []
        wait_until(lambda: events(robot.log(), "brown_out"))
    [died] = events(robot.log(), "brown_out")
    assert died.joint == "neck.pan"
    assert events(robot.log(), "unplugged") == []


def test_a_fault_that_cannot_come_is_refused_at_once(robot: SimulatedRobot) -> None:
    for fault, problem in {
        "brownout": "there is no fault 'brownout'; there is .*brown_out",
        "brown_out id=1": "brown_out: .*its keys are .*ids",
        "state": "name a fault",
        "": "there is no fault ''",
    }.items():
        with pytest.raises(SimulationError, match=problem):
            robot.fault_at(1.0, fault)
    time.sleep(0.5)
    for late_s in (0.1, float("nan")):
        with pytest.raises(SimulationError, match=r"the robot has been ready for .* s; name a fault and a later time"):
            robot.fault_at(late_s, "unplug")
    time.sleep(1.0)
    assert events(robot.log(), "unplugged") == events(robot.log(), "brown_out") == []


def test_a_fault_that_the_simulator_refuses_then_is_raised_at_the_end(head: Path) -> None:
    with pytest.raises(SimulationError, match="9"), simulated_robot(head) as robot:
        robot.fault_at(0.1, "jam ids=9")
        time.sleep(0.5)


@pytest.mark.parametrize("fault", ["unplug", "mute"])
def test_a_robot_whose_answers_end_moves_again_when_they_are_back(
    fault: str, robot: SimulatedRobot, mind: Container
) -> None:
    look = mind.find(where(name="move_to", group="rosie.head", kind="JointGroup"))
    getattr(robot.control, fault)()
    with pytest.raises(errors.DeviceSilent):
        look([0.3, 0.0])
    assert motion_writes(robot.log()) == []
    robot.control.replug()
    robot.control.heal()
    wait_until(lambda: _done(mind.robot("rosie").head.enable))
    assert look([0.3, 0.0]) == pytest.approx([0.3, 0.0], abs=0.01)


def _done(act: Callable[[], object]) -> bool:
    try:
        act()
    except errors.DeviceError:
        return False
    return True


def test_a_slower_bus_costs_fewer_cycles(head: Path) -> None:
    asked = list[int]()
    for rate_hz in (None, 10.0):
        with simulated_robot(head, rate_hz=rate_hz) as robot:
            time.sleep(2.0)
            asked.append(sum(entry.name == "sync_read" and entry.kind == "instruction" for entry in robot.log()))
    assert asked[1] < asked[0] / 5
