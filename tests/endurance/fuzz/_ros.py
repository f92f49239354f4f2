"""Messages of ROS 1 and ROS 2 as they travel."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from tests.endurance.fuzz._target import Target
from trade_gateway.ros.ros2._node import Attachment
from trade_gateway.ros_messages._types import Types

_DEFINITIONS: Final = Path(__file__).parents[2] / "unit" / "ros" / "ros2" / "definitions"
_KINDS: Final = (
    "std_msgs/msg/String",
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/JointState",
    "trajectory_msgs/msg/JointTrajectory",
    "std_msgs/msg/Float64MultiArray",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/BatteryState",
)
_TYPES: Final = {1: Types(1, []), 2: Types(2, [_DEFINITIONS])}


def _read(ros: int) -> Callable[[bytes], tuple[int, Any]]:
    """The first byte says of which type."""

    def read(data: bytes) -> tuple[int, Any]:
        number = data[0] % len(_KINDS) if data else 0
        return number, _TYPES[ros].from_bytes(_KINDS[number], data[1:])

    return read


def _write(ros: int) -> Callable[[tuple[int, Any]], bytes]:
    return lambda read: bytes([read[0]]) + _TYPES[ros].to_bytes(_KINDS[read[0]], read[1])


TARGETS: Final = [
    Target("ros1-message", _read(1), (ValueError,), _write(1)),
    Target("ros2-message", _read(2), (ValueError,), _write(2)),
    Target("ros2-attachment", Attachment.from_bytes, (ValueError,), Attachment.to_bytes),
]
