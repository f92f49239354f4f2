"""A robot's description in ROS, and the transforms of its links, against matrices that numpy multiplies."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.arms import FakeJoints
from tests.unit.ros.robots import Stand
from trade.errors import ConfigurationError
from trade_drivers.testing import FakeGripper
from trade_gateway.ros._urdf import read_urdf

pytestmark = pytest.mark.virtual_time

URDF = """<?xml version="1.0"?>
<!-- an arm with a camera and a gripper -->
<robot name="arm">
  <link name="base"/><link name="upper"/><link name="lower"/><link name="eye"/><link name="finger"/><link name="thumb"/>
  <joint name="a" type="revolute">
    <parent link="base"/><child link="upper"/>
    <origin xyz="0.1 0 0.3" rpy="0.2 -0.4 1.1"/><axis xyz="0 0 2"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="b" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0.2 0"/></joint>
  <joint name="mount" type="fixed"><parent link="lower"/><child link="eye"/><origin rpy="0 1.5707963 0"/></joint>
  <joint name="slide" type="prismatic">
    <parent link="lower"/><child link="finger"/><origin rpy="0 0 1.5707963267948966"/><axis xyz="1 0 0"/>
    <mimic joint="b" multiplier="0.02" offset="0.01"/>
  </joint>
  <joint name="free" type="revolute"><parent link="lower"/><child link="thumb"/></joint>
</robot>
"""
ROBOT = '[[to_ros.robot]]\ngroup = "rosie.arm"\nurdf = "arm.urdf"\n'


def about(axis: int, angle: float) -> np.ndarray:
    """The rotation about an axis of the frame."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[one, one] = matrix[two, two] = math.cos(angle)
    matrix[two, one], matrix[one, two] = math.sin(angle), -math.sin(angle)
    return matrix


def matrix(rotation: Mapping[str, float]) -> np.ndarray:
    """The rotation of a quaternion."""
    x, y, z, w = (rotation[name] for name in "xyzw")
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class Listener:
    """A node that has what was published last for each link, and the description."""

    def __init__(self, stand: Stand) -> None:
        self.node = stand.node("/rviz")
        self.texts: list[str] = []
        self.links: dict[str, Any] = {}
        self.node.subscribe("/robot_description", "std_msgs/msg/String", self._text, latched=True)
        self.node.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", self._heard, latched=True)
        self.node.subscribe("/tf", "tf2_msgs/msg/TFMessage", self._heard)

    def _text(self, message: Any, _: str) -> None:
        self.texts.append(message["data"])

    def _heard(self, message: Any, _: str) -> None:
        self.links.update({one["child_frame_id"]: one for one in message["transforms"]})


@pytest.fixture
def arm(stand: Stand) -> FakeJoints:
    made = FakeJoints("rosie.arm.a", "rosie.arm.b")
    made.at = [0.7, -0.3]
    stand.robot.container.register(made, "rosie.arm")
    stand.memory.settle()
    (stand.folder / "arm.urdf").write_text(URDF)
    return made


def test_links_are_where_the_description_and_the_joints_put_them(stand: Stand, arm: FakeJoints) -> None:
    stand.up(ROBOT)
    heard = Listener(stand)
    wait_until(lambda: {"upper", "lower", "eye", "finger"} <= set(heard.links))
    assert heard.texts == [URDF]
    assert "thumb" not in heard.links  # its joint is not measured
    origin = about(2, 1.1) @ about(1, -0.4) @ about(0, 0.2)
    wanted = {
        "upper": ((0.1, 0.0, 0.3), "base", origin @ about(2, 0.7)),
        "lower": ((0.0, 0.2, 0.0), "upper", about(0, -0.3)),
        "eye": ((0.0, 0.0, 0.0), "lower", about(1, 1.5707963)),
        "finger": ((0.0, 0.01 - 0.02 * 0.3, 0.0), "lower", about(2, math.pi / 2)),
    }
    for link, (xyz, parent, rotation) in wanted.items():
        transform = heard.links[link]["transform"]
        assert heard.links[link]["header"]["frame_id"] == parent
        assert [transform["translation"][name] for name in "xyz"] == pytest.approx(xyz)
        assert np.allclose(matrix(transform["rotation"]), rotation), link


def test_transforms_follow_the_joints(stand: Stand, arm: FakeJoints) -> None:
    stand.up(ROBOT)
    heard = Listener(stand)
    wait_until(lambda: "lower" in heard.links)
    arm.at = [0.7, 1.0]
    x = math.sin(0.5)
    wait_until(lambda: abs(heard.links["lower"]["transform"]["rotation"]["x"] - x) < 1e-9)


@pytest.mark.virtual_time
def test_a_gripper_shifts_a_prismatic_joint_and_turns_none(stand: Stand, arm: FakeJoints) -> None:
    """Its width is in m, so a revolute joint of its name would turn by a width."""
    for name in ("left.hand", "right.free"):
        stand.robot.container.register(FakeGripper(f"rosie.arm.{name}"), f"rosie.arm.{name}")
    stand.memory.settle()
    mimic = '    <mimic joint="b" multiplier="0.02" offset="0.01"/>\n'
    (stand.folder / "arm.urdf").write_text(URDF.replace('"slide"', '"hand"').replace(mimic, ""))
    stand.up(ROBOT)
    heard = Listener(stand)
    wait_until(lambda: {"upper", "lower", "finger"} <= set(heard.links))
    shift = heard.links["finger"]["transform"]["translation"]
    assert [shift[name] for name in "xyz"] == pytest.approx((0.0, 0.085, 0.0))
    assert "thumb" not in heard.links


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<robot", "is not XML"),
        ("<sdf/>", "its root is <sdf>, not <robot>"),
        ('<!DOCTYPE robot [<!ENTITY a "b">]><robot/>', "has a document type or entities"),
        ('<robot><joint name="a" type="ball"/></robot>', "its type is 'ball'; the bridge knows revolute"),
        ('<robot><joint name="a" type="fixed"/></robot>', "needs a parent and a child"),
        (URDF.replace('xyz="0.1 0 0.3"', 'xyz="0.1 0"'), "'0.1 0' is not 3 finite numbers"),
        (URDF.replace('xyz="0.1 0 0.3"', 'xyz="nan 0 0"'), "'nan 0 0' is not 3 finite numbers"),
        (URDF.replace('xyz="0 0 2"', 'xyz="0 0 0"'), "its axis has no direction"),
        (URDF.replace('name="b"', 'name="a"'), "two joints are called 'a'"),
    ],
)
def test_what_is_no_description_is_an_error_of_the_file(stand: Stand, text: str, says: str) -> None:
    (stand.folder / "arm.urdf").write_text(text)
    with pytest.raises(ConfigurationError) as wrong:
        stand.read(ROBOT)
    assert says in str(wrong.value)
    assert "arm.urdf" in str(wrong.value)


def test_a_missing_description_is_named(stand: Stand) -> None:
    with pytest.raises(ConfigurationError, match=r"arm\.urdf: cannot be read"):
        stand.read(ROBOT)


def test_angles_of_an_origin_turn_about_fixed_axes() -> None:
    inside = '<parent link="p"/><child link="c"/><origin rpy="0.5 0.6 0.7"/>'
    [joint] = read_urdf(f'<robot><joint name="a" type="fixed">{inside}</joint></robot>', "here")
    rotation = dict(zip("xyzw", joint.origin.rotation, strict=True))
    assert np.allclose(matrix(rotation), about(2, 0.7) @ about(1, 0.6) @ about(0, 0.5))
