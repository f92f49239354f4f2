"""The description of a robot in ROS, and the transforms of its links, as RViz and MoveIt need them."""

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from trade import Container
from trade.text_files import read_text
from trade_gateway.ros._file import RobotEntry
from trade_gateway.ros._graph import Graph
from trade_gateway.ros._joints import JointMeasurement
from trade_gateway.ros._urdf import Transform, UrdfJoint, read_urdf
from trade_gateway.ros.to_ros._streams import LimbTopic, Topics
from trade_gateway.ros_messages._conversion import ros_stamp
from trade_gateway.ros_messages._types import Message

_TF: Final = "tf2_msgs/msg/TFMessage"


class Description:
    """The description and the transforms of fixed joints, published once for all, also for later subscribers."""

    def __init__(self, entry: RobotEntry, graph: Graph) -> None:
        """Raises ConfigurationError: the file cannot be read any more."""
        text = read_text(Path(entry.urdf))
        self._publishers = [
            graph.advertise(entry.topic, "std_msgs/msg/String", latched=True),
            graph.advertise("/tf_static", _TF, latched=True),
        ]
        joints = read_urdf(text, entry.urdf)
        fixed = [_stamped(joint, joint.origin, time.time()) for joint in joints if joint.fixed]
        self._publishers[0].send({"data": text})
        self._publishers[1].send({"transforms": fixed})

    def close(self) -> None:
        """Withdraws them."""
        for publisher in self._publishers:
            publisher.close()


class TransformsToRos(LimbTopic):
    """``[[to_ros.robot]]``: the transforms of the joints that are measured; a gripper moves a prismatic one."""

    def __init__(self, entry: RobotEntry, topics: Topics, container: Container) -> None:
        """Raises ConfigurationError: the description is invalid."""
        super().__init__(entry, "/tf", _TF, topics, container)
        description = read_text(Path(entry.urdf))
        self._moving = [one for one in read_urdf(description, entry.urdf) if not one.fixed]
        self._turning = {joint.name for joint in self._moving if joint.turns}

    def _message(self, names: Sequence[str], now: JointMeasurement, at_s: float) -> Message:
        positions = dict(zip(names, now.positions, strict=True))
        if now.is_width:  # in m, which is no angle
            positions = {name: width_m for name, width_m in positions.items() if name not in self._turning}
        return {"transforms": list(self._transforms(positions, at_s))}

    def _transforms(self, positions: Mapping[str, float], at_s: float) -> Iterable[Message]:
        for joint in self._moving:
            name, multiplier, offset = joint.mimic or (joint.name, 1.0, 0.0)
            if name in positions:
                yield _stamped(joint, joint.at(multiplier * positions[name] + offset), at_s)


def _stamped(joint: UrdfJoint, transform: Transform, at_s: float) -> Message:
    return {
        "header": {"stamp": ros_stamp(at_s), "frame_id": joint.parent},
        "child_frame_id": joint.child,
        "transform": {
            "translation": dict(zip("xyz", transform.xyz_m, strict=True)),
            "rotation": dict(zip("xyzw", transform.rotation, strict=True)),
        },
    }
