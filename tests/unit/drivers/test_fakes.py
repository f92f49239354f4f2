"""Devices in memory keep what the contracts say of everything but time, and fail when a test lets them."""

import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Run, where
from trade.errors import Cancelled, DeviceFault, DeviceSilent, InvalidArgument, LockedByOther, MotionStopped, Stopped
from trade.testing import MemorySystem, memory_system
from trade_drivers import Arm, Camera, Gripper, JointGroup, JointLimits, Motor, Sensor
from trade_drivers.testing import (
    ArmContract,
    CameraContract,
    FakeArm,
    FakeCamera,
    FakeGripper,
    FakeJointGroup,
    FakeMotor,
    FakeSensor,
    GripperContract,
    JointGroupContract,
    MotorContract,
    SensorContract,
)

pytestmark = pytest.mark.virtual_time

JOINTS = ["rosie.neck.pan", "rosie.neck.tilt"]
ANGLES = [0.1, -0.2, 0.3, 0.0, 0.5, -0.6]


class TestFakeMotor(MotorContract):
    @pytest.fixture
    def motor(self) -> Motor:
        return FakeMotor("rosie.neck.pan")

    test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it = None  # type: ignore[assignment]
    test_a_new_move_takes_over_and_the_one_before_hears_of_it = None  # type: ignore[assignment]
    test_relax_ends_a_move = None  # type: ignore[assignment]
    test_S04_a_velocity_that_is_not_renewed_ends_by_itself = None  # type: ignore[assignment]  # noqa: N815


class TestFakeJointGroup(JointGroupContract):
    @pytest.fixture
    def group(self) -> JointGroup:
        return FakeJointGroup(JOINTS)

    test_joints_with_ways_of_different_length_are_on_their_way_together = None  # type: ignore[assignment]
    test_stop_ends_the_motion_of_all_and_the_mover_hears_of_it = None  # type: ignore[assignment]
    test_its_progress_is_reported = None  # type: ignore[assignment]
    test_stop_ends_a_trajectory = None  # type: ignore[assignment]
    test_a_move_takes_over_from_a_trajectory = None  # type: ignore[assignment]


class TestFakeGripper(GripperContract):
    @pytest.fixture
    def gripper(self) -> Gripper:
        gripper = FakeGripper("rosie.left.hand")
        gripper.activate()
        return gripper

    test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it = None  # type: ignore[assignment]


class TestFakeArm(ArmContract):
    @pytest.fixture
    def arm(self) -> Arm:
        return FakeArm("rosie.right")

    test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it = None  # type: ignore[assignment]
    test_two_who_move_it_at_once_do_not_both_arrive = None  # type: ignore[assignment]


class TestFakeCamera(CameraContract):
    @pytest.fixture
    def camera(self) -> Camera:
        return FakeCamera("rosie.eye")


class TestFakeSensor(SensorContract):
    @pytest.fixture
    def sensor(self) -> Sensor:
        return FakeSensor("rosie.oven.temperature", 21.5, "degC")


class TestFakeVectorSensor(SensorContract):
    @pytest.fixture
    def sensor(self) -> Sensor:
        return FakeSensor("rosie.wrist", [0.0, 1.0, -9.8], "N")


def started(device: Any) -> Any:
    if isinstance(device, FakeGripper):
        device.activate()
        device.commands.clear()
    return device


MOVERS: list[tuple[Callable[[], Any], str, Any]] = [
    (lambda: FakeMotor("rosie.device"), "move_to", 0.3),
    (lambda: FakeJointGroup(JOINTS), "move_to", [0.3, -0.2]),
    (lambda: started(FakeGripper("rosie.device")), "move_to", 0.03),
    (lambda: FakeArm("rosie.device"), "move_joints", ANGLES),
]
each_mover = pytest.mark.parametrize(("make", "service", "goal"), MOVERS, ids=["motor", "group", "gripper", "arm"])


@each_mover
def test_it_records_what_was_commanded_in_order(make: Callable[[], Any], service: str, goal: Any) -> None:
    device = make()
    getattr(device, service)(goal)
    device.stop()
    assert device.commands == [(service, goal), ("stop", None)]
    assert device.went == [goal]


@each_mover
def test_a_fault_refuses_commands_until_it_recovers(make: Callable[[], Any], service: str, goal: Any) -> None:
    device = make()
    device.fail("overload")
    with pytest.raises(DeviceFault, match="overload"):
        getattr(device, service)(goal)
    assert device.commands == []
    states = device.state() if isinstance(device, FakeJointGroup) else [device.state()]
    assert {state.fault for state in states} == {"overload"}
    device.recover()
    getattr(device, service)(goal)
    assert device.went == [goal]


@each_mover
def test_a_silent_device_has_no_state_and_confirms_no_stop(make: Callable[[], Any], service: str, goal: Any) -> None:
    device = make()
    device.go_silent()
    for act in (device.state, device.stop, lambda: getattr(device, service)(goal)):
        with pytest.raises(DeviceSilent):
            act()
    assert device.commands == [("stop", None)]
    device.recover()
    device.state()


@each_mover
def test_locks_and_e_stops_refuse_what_others_command(make: Callable[[], Any], service: str, goal: Any) -> None:
    device = make()
    with memory_system() as system:
        robot, owner, mind = (system.container(name) for name in ("robot", "owner", "mind"))
        robot.register(device, "rosie.it")
        move = mind.find(where(name=service, group="rosie.it"))
        with owner.lock(where(group="rosie.it")), pytest.raises(LockedByOther):
            move(goal)
        assert system.container("guard").estop("smoke").complete
        with pytest.raises(Stopped):
            move(goal)
    assert device.went == []


def test_it_is_found_as_a_joint_group_and_an_e_stop_holds_it() -> None:
    group = FakeJointGroup(JOINTS)
    with memory_system() as system:
        robot, mind = system.container("robot"), system.container("mind")
        robot.register(group, "rosie.head")
        move = mind.find(where(name="move_to", group="rosie.head", kind="JointGroup"))
        assert move([0.3, -0.2]) == [0.3, -0.2]
        assert mind.find(where(name="state", group="rosie.head"))()[0].position_rad == 0.3
        assert system.container("guard").estop("smoke").complete
        with pytest.raises(Stopped):
            move([0.0, 0.0])
    assert group.went == [[0.3, -0.2]]


def test_enable_clears_the_fault_of_a_motor() -> None:
    motor = FakeMotor("rosie.neck.pan")
    motor.fail("overload")
    motor.enable()
    assert motor.move_to(0.5) == 0.5


def test_a_faulty_motor_can_be_relaxed() -> None:
    motor = FakeMotor("rosie.neck.pan")
    motor.enable()
    motor.fail("overload")
    motor.relax()
    assert (motor.state().enabled, motor.state().fault) == (False, "overload")


def test_a_joint_begins_in_its_range() -> None:
    limits = JointLimits(name="elbow", min_rad=0.25, max_rad=1.0, max_speed_rad_s=2.5, max_accel_rad_s2=20.0)
    assert FakeMotor("elbow", limits).state().position_rad == 0.25
    assert FakeJointGroup(["elbow"], [limits]).state()[0].position_rad == 0.25


def test_a_velocity_turns_a_motor_as_far_as_its_range() -> None:
    motor = FakeMotor("rosie.neck.pan")
    motor.set_velocity(1.0, 0.5)
    assert motor.state().position_rad == 0.5
    for _ in range(3):
        motor.set_velocity(6.0, 0.5)
    assert motor.state().position_rad == motor.limits().max_rad


def test_one_faulty_motor_refuses_the_motion_of_its_group() -> None:
    group = FakeJointGroup(JOINTS)
    group.motors[1].fail("overheated")
    with pytest.raises(DeviceFault, match=r"rosie\.neck\.tilt"):
        group.move_to([0.1, 0.1])
    assert [state.position_rad for state in group.state()] == [0.0, 0.0]
    group.enable()
    assert group.move_to([0.1, 0.1]) == [0.1, 0.1]
    assert group.motors[0].state().position_rad == 0.1


def test_a_gripper_moves_only_once_activated() -> None:
    gripper = FakeGripper("rosie.left.hand")
    with pytest.raises(DeviceFault, match="activate"):
        gripper.close()
    assert gripper.commands == []
    gripper.activate()
    gripper.fail("jammed")
    gripper.clear_fault()
    with pytest.raises(DeviceFault, match="activate"):
        gripper.close()


def test_a_gripper_holds_the_object_between_its_fingers_until_it_opens() -> None:
    gripper = FakeGripper("rosie.left.hand")
    gripper.activate()
    gripper.object_width_m = 0.03
    assert (gripper.close().width_m, gripper.state().holding) == (0.03, "outside")
    assert gripper.open().holding == ""
    gripper.object_width_m = None
    assert (gripper.close().width_m, gripper.state().holding) == (0.0, "")


def test_a_protective_stop_lasts_until_it_is_unlocked() -> None:
    arm = FakeArm("rosie.right")
    with pytest.raises(DeviceFault, match="no protective stop"):
        arm.unlock_protective_stop()
    arm.trip("protective stop")
    assert arm.safety_state() == "protective stop"
    with pytest.raises(DeviceFault, match="protective stop"):
        arm.move_joints(ANGLES)
    assert arm.commands == []
    arm.unlock_protective_stop()
    assert arm.move_joints(ANGLES) == ANGLES


def test_a_fault_ends_freedrive_and_refuses_another() -> None:
    arm = FakeArm("rosie.right")
    arm.freedrive(True)
    arm.fail("joint 3 overheated")
    assert (arm.state().freedrive, arm.resources[0].moving) == (False, False)
    assert (arm.safety_state(), arm.state().fault) == ("fault", "joint 3 overheated")
    with pytest.raises(DeviceFault, match="joint 3"):
        arm.freedrive(True)
    arm.freedrive(False)
    assert arm.commands == [("freedrive", None), ("freedrive", None)]


def test_an_arm_after_an_emergency_stop_needs_power_and_released_brakes() -> None:
    arm = FakeArm("rosie.right")
    arm.trip("emergency stop")
    arm.recover()
    with pytest.raises(DeviceFault, match="the power is off"):
        arm.release_brakes()
    arm.power_on()
    with pytest.raises(DeviceFault, match="release_brakes"):
        arm.move_joints(ANGLES)
    arm.release_brakes()
    assert arm.move_to_pose("home") == [0.0] * 6
    assert arm.move_line([0.3, 0.0, 0.4, 0.0, 0.0, 0.0])[0] == arm.state().pose[0] == 0.3


def test_each_image_is_the_same_in_each_run_and_differs_from_the_one_before() -> None:
    one, other = FakeCamera("rosie.eye"), FakeCamera("rosie.eye")
    first, second = one.image().data, one.image().data
    assert first != second
    assert [other.image().data for _ in range(2)] == [first, second]


def test_a_camera_shows_what_the_test_sets() -> None:
    camera = FakeCamera("rosie.eye", width_px=2, height_px=1)
    camera.show(b"\xff\x00\x00\x00\xff\x00")
    assert camera.image().data == b"\xff\x00\x00\x00\xff\x00"
    with pytest.raises(InvalidArgument, match="6"):
        camera.show(b"\xff")
    camera.fail("lens covered")
    with pytest.raises(DeviceFault, match="lens covered"):
        camera.image()


def test_a_reading_is_what_the_test_sets_and_doubtful_outside_the_range() -> None:
    sensor = FakeSensor("rosie.oven.temperature", 21.5, "degC", high=300.0)
    sensor.set(180.0)
    assert (sensor.read().value, sensor.read().quality) == (180.0, "good")
    sensor.set(400.0)
    assert sensor.read().quality == "doubtful"
    sensor.go_silent()
    with pytest.raises(DeviceSilent):
        sensor.read()


@pytest.mark.parametrize("value", [math.nan, math.inf, [1.0], []], ids=str)
def test_a_sensor_takes_only_finite_values_of_its_size(value: Any) -> None:
    sensor = FakeSensor("rosie.oven.temperature", 21.5, "degC")
    with pytest.raises(InvalidArgument):
        sensor.set(value)
    assert sensor.read().value == 21.5


def test_a_sensor_has_a_unit_of_readings() -> None:
    with pytest.raises(InvalidArgument, match="degC"):
        FakeSensor("rosie.oven.temperature", 70.0, "F")


def activated_gripper() -> FakeGripper:
    gripper = FakeGripper("rosie.left.hand")
    gripper.activate()
    return gripper


HELD_UP = [
    (lambda: FakeMotor("rosie.neck.pan"), "move_to", 0.3),
    (lambda: FakeJointGroup(JOINTS), "move_to", [0.3, -0.2]),
    (lambda: FakeArm("rosie.right"), "move_joints", [0.1] * 6),
    (activated_gripper, "move_to", 0.02),
]


@pytest.fixture(params=HELD_UP, ids=["motor", "group", "arm", "gripper"])
def held_up(request: pytest.FixtureRequest, trade_system: MemorySystem) -> Iterator[tuple[Any, Run]]:
    """A device and a motion of it that has begun and does not arrive."""
    make, move, goal = request.param
    device = make()
    if hasattr(device, "enable"):
        device.enable()
    device.commands.clear()
    device.arrives.clear()
    trade_system.container("robot").register(device, "rosie.part")
    trade_system.container("mind")
    trade_system.settle()
    run = trade_system.container("mind").find(f"rosie.part.{move}").start(goal)
    wait_until(lambda: shows_motion(device))
    yield device, run
    device.arrives.set()


def shows_motion(device: Any) -> bool:
    state = device.state()
    return all(one.moving for one in (state if isinstance(state, list) else [state]))


def test_a_motion_lasts_until_the_test_lets_it_arrive(held_up: tuple[Any, Run]) -> None:
    device, run = held_up
    assert not run.done()
    device.arrives.set()
    run.result(30)
    assert len(device.went) == 1
    assert not shows_motion(device)


@pytest.mark.parametrize("how", ["cancelled", "stopped"])
def test_a_motion_that_is_held_up_is_cancelled_or_stopped(
    held_up: tuple[Any, Run], trade_system: MemorySystem, how: str
) -> None:
    device, run = held_up
    if how == "cancelled":
        run.ask_to_end()
    else:
        trade_system.container("mind").stop("rosie.part")
    assert isinstance(run.exception(30), Cancelled | MotionStopped)
    assert device.went == []
    assert not shows_motion(device)


def test_a_motion_that_is_held_up_ends_with_its_deadline() -> None:
    with memory_system() as system:
        motor = FakeMotor("rosie.neck.pan")
        motor.enable()
        motor.commands.clear()
        motor.arrives.clear()
        robot = system.container("robot")
        robot.register(motor, motor.name)
        with pytest.raises(MotionStopped, match="deadline"):
            robot.find("rosie.neck.pan.move_to").with_(deadline_s=0.2)(0.3)
        assert motor.went == []


@pytest.mark.realtime
def test_the_example_of_a_behaviour_passes_its_own_test() -> None:
    examples = Path(__file__).parents[3] / "examples"
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "test_handover.py"]
    environment = {**os.environ, "PYTHONPATH": str(examples)}
    ran = subprocess.run(command, cwd=examples, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout
    assert "3 passed" in ran.stdout
