"""The contracts of all kinds of devices, on the simulations of robot files. A new device only names its file here."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tests.support.simulated_robots import HAND, HEAD, TAIL
from tests.support.waiting import wait_until
from tests.unit.drivers import test_across
from tests.unit.drivers.legs import LEG
from tests.unit.drivers.motor_rig import DAMIAO, ODRIVE
from trade import where
from trade.errors import DeviceError
from trade_drivers import AttachedRobot, JointGroup, Motor, Robot, attach, parse
from trade_drivers.testing import JointGroupContract, MotorContract
from trade_hil_sim import ByteLog, SimProcess, events
from trade_hil_sim.robot._robot import buses_of
from trade_robotfile import Bus

pytestmark = pytest.mark.realtime

FILES = {
    "head": HEAD,
    "fast": HEAD.replace('driver = "dynamixel"', 'driver = "dynamixel"\nfast_sync = true'),
    "legs": test_across.LEGS,
    "body": HEAD
    + "".join(text[text.index("[bus.") :] for text in (LEG, HAND))
    + '\n[group.body]\njoints = ["neck.tilt", "leg.hip", "neck.pan", "leg.knee"]\n',
    "feetech": TAIL,
    "odrive": ODRIVE,
    "damiao": DAMIAO,
}
"""Robot files by name."""
TAILS = ("feetech", "odrive", "damiao")
MOTORS = [
    *(("head", "neck.pan"), ("head", "neck.tilt"), ("fast", "neck.pan"), ("body", "leg.hip"), ("body", "leg.knee")),
    *((tail, joint) for tail in TAILS for joint in ("tail.root", "tail.tip")),
]
ELSEWHERE = {
    "robotiq": "test_robotiq_gripper.py",
    "snapshot": "test_senses.py",
    "ur": "test_ur_contract.py",
}
"""Drivers whose contracts are run in modules of their own."""
GROUPS = [("head", "head"), ("legs", "legs"), ("body", "leg"), ("body", "body"), *((tail, "tail") for tail in TAILS)]


@pytest.fixture(scope="module")
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttachedRobot]:
    """The robot of a file, on simulated buses in this process: a starved one of its own looks like silence."""
    name = request.param
    file = parse(_patient(FILES[name]), f"{name}.toml")
    with ExitStack() as undo:
        buses = buses_of(file, tmp_path_factory.mktemp(name), log=ByteLog(keep=False), paced=False)
        for bus in buses:
            undo.callback(bus.close)
            bus.open()
        ports = {bus.name: str(bus.port) for bus in buses}
        yield undo.enter_context(attach(file, announced=False, ports=ports))


def _patient(text: str) -> str:
    """A robot file whose devices may be silent for a second: a computer that is suspended for a moment is no fault."""

    def waiting(driver: re.Match[str]) -> str:
        longest = {"robotiq": "", "odrive": "watchdog_s = 0.5"}.get(driver[1], "watchdog_s = 1")
        return f"{driver[0]}\nstale_after_s = 1\n{longest}"

    return re.sub('(?m)^driver = "(.*)"', waiting, re.sub(r"(?m)^(stale_after_s|watchdog_s) = .*\n", "", text))


def _is_sound(device: Motor | JointGroup) -> bool:
    """Whether it answers and has no fault; a test before it may have been too late for its watchdog."""
    try:
        states = device.state()
        if any(state.fault for state in (states if isinstance(states, list) else [states])):
            device.enable()
            device.relax()
            return False
    except DeviceError:
        return False
    return True


@pytest.mark.parametrize(("robot", "joint"), MOTORS, indirect=["robot"], scope="module")
class TestMotor(MotorContract):
    @pytest.fixture
    def motor(self, robot: AttachedRobot, joint: str) -> Iterator[Motor]:
        motor = robot.motor(joint)
        wait_until(lambda: _is_sound(motor), "it answers, without a fault")
        yield motor
        motor.relax()


@pytest.mark.parametrize(("robot", "name"), GROUPS, indirect=["robot"], scope="module")
class TestJointGroup(JointGroupContract):
    @pytest.fixture
    def group(self, robot: AttachedRobot, name: str) -> Iterator[JointGroup]:
        group = robot.group(name)
        wait_until(lambda: _is_sound(group), "it answers, without a fault")
        yield group
        group.relax()


def test_every_simulator_has_its_contracts() -> None:
    files = {name: parse(text, f"{name}.toml") for name, text in FILES.items()}
    drivers = {bus.driver for file, joint in MOTORS for bus in files[file].buses if _is_on(files[file], bus, joint)}
    assert drivers | ELSEWHERE.keys() == {simulator.name for simulator in entry_points(group="trade.sims")}
    for module in ELSEWHERE.values():
        assert "Contract):" in Path(test_across.__file__).with_name(module).read_text(), module


def _is_on(robot: Robot, bus: Bus, joint: str) -> bool:
    return any(record.name == joint for record in robot.joints_on(bus.name))


@pytest.mark.parametrize("robot", ["body"], indirect=True, scope="module")
def test_servos_drives_and_grippers_are_one_robot(robot: AttachedRobot) -> None:
    wait_until(lambda: _is_sound(robot.group("body")), "it answers, without a fault")
    assert robot.group("body").joints() == ["rosie.neck.tilt", "rosie.leg.hip", "rosie.neck.pan", "rosie.leg.knee"]
    assert [state.enabled for state in robot.group("body").state()] == 4 * [False]
    assert robot.gripper("left.hand").state().fault == ""


@pytest.fixture
def head_file(tmp_path: Path) -> Path:
    file = tmp_path / "head.toml"
    file.write_text(HEAD)
    return file


def hil(file: Path, sim: SimProcess, *words: str, says: str = "") -> "subprocess.CompletedProcess[str]":
    ports = [f"--port={bus}={port}" for bus, port in sim.ports.items()]
    command = [sys.executable, "-m", "trade_drivers.testing", "--hil", str(file), *ports, *words]
    return subprocess.run(command, input=says, capture_output=True, text=True, timeout=100, check=False, env=os.environ)


def test_the_contracts_run_on_every_joint_and_group_of_a_robot_file(system: str, head_file: Path) -> None:
    with SimProcess(head_file, paced=False) as sim:
        ended = hil(head_file, sim, "--yes", "-k", "state_has or order_of or enable_holds")
        assert ended.returncode == 0, ended.stdout + ended.stderr
        for device in ("rosie.neck.pan", "rosie.neck.tilt", "rosie.head"):
            assert f"[{device}] PASSED" in ended.stdout
        assert len(events(sim.entries(), "torque_on")) == len(events(sim.entries(), "torque_off")) > 0


def test_grippers_are_opened_and_closed_only_after_a_separate_confirmation(system: str, tmp_path: Path) -> None:
    file = tmp_path / "hand.toml"
    file.write_text(HAND)
    with SimProcess(file, paced=False) as sim:
        refused = hil(file, sim, says="no\n")
        assert refused.returncode == 2
        assert "CLOSED" in refused.stderr
        assert "RELAXED" not in refused.stderr
        ended = hil(file, sim, "-k", "go_to_the_ends or no_number", says="yes\n")
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert ended.stdout.count("[rosie.left.hand] PASSED") == 2


def test_a_broken_contract_is_reported(system: str, head_file: Path) -> None:
    head_file.write_text(HEAD.replace("min_rad = -1.4", "min_rad = 0.2"))  # it is found outside of its range
    with SimProcess(head_file, paced=False) as sim:
        ended = hil(head_file, sim, "--yes", "-k", "state_has")
        assert ended.returncode == 1
        assert "[rosie.neck.pan] FAILED" in ended.stdout


@pytest.mark.parametrize("answer", ["", "no\n", "y\n"])
def test_nothing_moves_without_confirmation(system: str, head_file: Path, answer: str) -> None:
    with SimProcess(head_file, paced=False) as sim:
        ended = hil(head_file, sim, says=answer)
        assert ended.returncode == 2
        assert "RELAXED" in ended.stderr
        assert not sim.entries()


def test_a_robot_that_is_in_use_is_left_alone(
    system: str, head_file: Path, start_container: Callable[..., object]
) -> None:
    class Pan:
        """Stands for a driver on any host."""

        from trade import service

        @service(effect="actuate", cancel="stop", uses=["rosie.neck.pan"])
        def move_to(self, position_rad: float) -> None: ...

        @service(effect="stop")
        def stop(self) -> None: ...

    driver, walker = start_container("driver"), start_container("walker")
    driver.register(Pan(), "rosie.neck.pan")  # type: ignore[attr-defined]
    with SimProcess(head_file, paced=False) as sim, walker.lock(where(group="rosie"), purpose="a walk"):  # type: ignore[attr-defined]
        ended = hil(head_file, sim, "--yes")
        assert ended.returncode == 2
        assert "driver on" in ended.stderr
        assert "a walk" in ended.stderr
        assert not sim.entries()
