"""Values that TRADE services read are published on topics while they are valid."""

import threading
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.arms import FakeJoints
from tests.unit.ros.robots import Stand
from trade_drivers.testing import FakeGripper

pytestmark = pytest.mark.virtual_time

ANGLE = (
    '[[to_ros.stream]]\nservice = "rosie.head.angle_rad"\ntopic = "/head"\ntype = "std_msgs/msg/Float64"\nhz = 100\n'
)
JOINTS = '[[to_ros.joint_states]]\ngroup = "rosie.arm"\nhz = 100\n'


def heard(stand: Stand, topic: str, kind: str) -> list[Any]:
    """What a node of ROS hears there."""
    messages: list[Any] = []
    stand.node("/listener").subscribe(topic, kind, lambda message, who: messages.append(message))
    return messages


def test_a_number_is_published_as_data(stand: Stand) -> None:
    stand.robot.head.angle = 0.75
    stand.up(ANGLE)
    messages = heard(stand, "/head", "std_msgs/msg/Float64")
    wait_until(lambda: messages)
    assert messages[0] == {"data": 0.75}


def test_a_record_is_published_by_the_names_of_its_fields_or_as_the_file_says(stand: Stand) -> None:
    stand.robot.head.angle = 0.5
    stand.up(
        '[[to_ros.stream]]\nservice = "rosie.head.state"\ntopic = "/point"\ntype = "geometry_msgs/msg/PointStamped"\n'
        'hz = 100\nfields = { "point.z" = "position_rad" }\n'
    )
    messages = heard(stand, "/point", "geometry_msgs/msg/PointStamped")
    wait_until(lambda: messages)
    assert messages[0]["point"] == {"x": 0.0, "y": 0.0, "z": 0.5}
    assert messages[0]["header"]["stamp"]["sec"] > 1_600_000_000


def test_nothing_is_published_while_the_service_fails_and_again_when_it_does_not(stand: Stand) -> None:
    stand.up(
        '[[to_ros.stream]]\nservice = "rosie.head.state"\ntopic = "/head"\ntype = "std_msgs/msg/Float64"\n'
        'hz = 100\nfields = { data = "position_rad" }\n'
    )
    messages = heard(stand, "/head", "std_msgs/msg/Float64")
    wait_until(lambda: messages)
    stand.robot.head.angle, stand.robot.head.silent = 0.9, True
    wait_until(lambda: _still(messages))
    assert all(message["data"] == 0.0 for message in messages)
    stand.robot.head.silent = False
    wait_until(lambda: messages[-1]["data"] == 0.9)


def _still(messages: list[Any]) -> bool:
    before = len(messages)
    threading.Event().wait(0.1)
    return len(messages) == before


def test_joint_states_have_names_values_and_the_time_of_their_measurement(stand: Stand) -> None:
    arm = FakeJoints("rosie.arm.a", "rosie.arm.b")
    arm.at = [0.1, 0.2]
    stand.robot.container.register(arm, "rosie.arm")
    stand.memory.settle()
    stand.up(
        JOINTS + '[[to_ros.stream]]\nservice = "rosie.head.angle_rad"\ntopic = "/now"\n'
        'type = "geometry_msgs/msg/PointStamped"\nfields = { "point.x" = "" }\n'
    )
    messages = heard(stand, "/joint_states", "sensor_msgs/msg/JointState")
    wait_until(lambda: messages)
    message = messages[0]
    assert (message["name"], message["position"], message["velocity"]) == (["a", "b"], [0.1, 0.2], [0.5, 0.5])
    assert message["header"]["stamp"]["sec"] > 1_600_000_000
    assert message["effort"] == []


def test_joint_states_are_not_published_while_they_are_silent_or_unhealthy(stand: Stand) -> None:
    arm = FakeJoints("rosie.arm.a")
    stand.robot.container.register(arm, "rosie.arm")
    stand.memory.settle()
    stand.up(JOINTS)
    messages = heard(stand, "/joint_states", "sensor_msgs/msg/JointState")
    wait_until(lambda: messages)
    stand.robot.container.set_health(arm, "its bus is gone")
    wait_until(lambda: _still(messages))
    stand.robot.container.set_health(arm)
    count = len(messages)
    wait_until(lambda: len(messages) > count)
    arm.silent = True
    wait_until(lambda: _still(messages))


def test_names_are_full_or_as_the_file_says_and_never_twice(stand: Stand) -> None:
    arm = FakeJoints("rosie.arm.a", "rosie.arm.b")
    both = FakeJoints("left.arm.a", "right.arm.a")
    stand.robot.container.register(arm, "rosie.arm")
    stand.robot.container.register(both, "both")
    stand.memory.settle()
    bridge = stand.up(
        JOINTS + 'names = "full"\njoints = { shoulder = "rosie.arm.a" }\n' + JOINTS.replace("rosie.arm", "both")
    )
    messages = heard(stand, "/joint_states", "sensor_msgs/msg/JointState")
    wait_until(lambda: messages)
    assert messages[0]["name"] == ["shoulder", "rosie.arm.b"]
    assert "two of left.arm.a, right.arm.a would have one name" in bridge.bridged().problems[0]


@pytest.mark.virtual_time
@pytest.mark.parametrize("group", ["rosie.left", "rosie.left.hand", "rosie"])
def test_a_gripper_is_one_joint_whose_position_is_its_width_in_m(stand: Stand, group: str) -> None:
    hand, arm = FakeGripper("rosie.left.hand"), FakeJoints("rosie.left.a", "rosie.left.b")
    arm.at = [0.1, 0.2]
    stand.robot.container.register(hand, "rosie.left.hand")
    stand.robot.container.register(arm, "rosie.left")
    stand.memory.settle()
    bridge = stand.up(JOINTS.replace("rosie.arm", group))
    messages = heard(stand, "/joint_states", "sensor_msgs/msg/JointState")
    wait_until(lambda: any(message["name"] == ["hand"] for message in messages))
    hand.activate()
    hand.close()
    wait_until(lambda: any(one["name"] == ["hand"] and one["position"] == [0.0] for one in messages))
    widths = [one["position"] for one in messages if one["name"] == ["hand"]]
    assert widths[0] == [0.085]
    arms = [one["position"] for one in messages if one["name"] == ["a", "b"]]
    assert all(one == [0.1, 0.2] for one in arms)
    assert bool(arms) is (group == "rosie.left")
    assert bridge.bridged().problems == []


def test_a_topic_ends_with_its_service(stand: Stand) -> None:
    stand.up(ANGLE)
    messages = heard(stand, "/head", "std_msgs/msg/Float64")
    wait_until(lambda: messages)
    stand.robot.container.deregister(stand.robot.head)
    wait_until(lambda: any("topic /head is gone" in line for line in stand.said))
    wait_until(lambda: _still(messages))
