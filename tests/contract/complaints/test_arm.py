"""Complaints of other projects about grippers beside arms, speed sliders, and controllers that lack a service."""

import threading
from pathlib import Path
from typing import Any

import pytest

from tests.contract.complaints import arm_mutants as mutants
from tests.contract.complaints.bodies import Controllers, outcome
from tests.contract.complaints.table import complaint
from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import ArmRig
from tests.unit.drivers.attached_arm import AT_HOME
from tests.unit.ros.robots import Stand
from trade.testing import memory_system
from trade_drivers import Tolerances, Trajectory, TrajectoryPoint
from trade_drivers.testing import FakeGripper
from trade_drivers.vendors.ur import identify
from trade_gateway.cli.hardware._doctor_robot import controllers
from trade_gateway.recording._sources import RecordedParts, Sources
from trade_gateway.recording._timeline import Timeline

pytestmark = pytest.mark.realtime
HAND = "rosie.left.hand"
STATES = f'[[to_ros.joint_states]]\ngroup = "{HAND}"\nhz = 100\n'


@complaint(
    ("folder", mutants.joint_states_are_of_arms_alone, "ROS hears of the gripper"),
    ("folder", mutants.recordings_are_of_arms_alone, "the recording lacks the gripper"),
)
def test_a_gripper_is_missing_from_joint_states(folder: Path) -> None:
    with memory_system() as system:
        stand, hand = Stand(system, folder), FakeGripper(HAND)
        stand.robot.container.register(hand, HAND)
        system.settle()
        heard: list[Any] = []
        stand.node().subscribe("/joint_states", "sensor_msgs/msg/JointState", lambda said, _: heard.append(said))
        try:
            stand.up(STATES)
            wait_until(
                lambda: any((one["name"], one["position"]) == (["hand"], [0.085]) for one in heard),
                "ROS hears of the gripper",
            )
            hand.activate()
            hand.close()
            wait_until(lambda: heard[-1]["position"] == [0.0], "ROS hears that the gripper has closed")
            recorded = Sources(stand.container, RecordedParts(groups=["rosie"]), threading.Event(), Timeline())
            recorded.look()
            assert f"{HAND}.state" in recorded.labels(), "the recording lacks the gripper"
            recorded.close()
        finally:
            stand.close()


@complaint(("arm", mutants.no_error_mentions_the_slider, "blocked or overloaded"))
def test_a_speed_slider_looks_like_an_obstacle(rig: ArmRig) -> None:
    rig.arm.set_speed_scaling(0.1)
    wait_until(lambda: rig.arm.state().speed_scaling == 0.1, "the slider is set")
    way = Trajectory(
        joints=[limit.name for limit in rig.arm.limits().joints],
        points=[
            TrajectoryPoint(time_from_start_s=at_s, positions_rad=[angle, *AT_HOME[1:]], velocities_rad_s=[0.0] * 6)
            for at_s, angle in ((0.0, 0.0), (2.5, 1.0))
        ],
    )
    reported = outcome(lambda: rig.arm.follow(way, Tolerances(path_rad=0.05)))
    assert reported.startswith("ToleranceExceeded"), reported
    assert "its speed slider is at 10 %" in reported, reported
    rig.comes_to_rest()


@complaint(
    ("controllers", mutants.the_dashboard_answers_for_the_controller, "doctor finds nothing wrong"),
    ("controllers", mutants.a_scan_asks_the_dashboard_alone, "no controller of an arm answers"),
)
def test_a_missing_service_looks_like_a_dead_controller(plugged: Controllers) -> None:
    robot, _ = plugged.lacking("rtde")
    found = [one for one in controllers(robot) if one.level == "error"]
    assert found, "doctor finds nothing wrong"
    assert "has no RTDE (port 30004)" in found[0].text
    _, host = plugged.lacking("dashboard")
    reported = outcome(lambda: identify(host))
    assert "has no dashboard server (port 29999), but it has RTDE (port 30004)" in reported, reported
    refused = outcome(lambda: plugged.attach(host))
    assert "has no dashboard server (port 29999), but it has RTDE (port 30004)" in refused, refused
