"""A bridge between TRADE and ROS: topics, services, actions and joints of each side, offered on the other."""

from trade._protocol.schema_types import publish as _publish
from trade_gateway.ros._bridge import Bridge, Bridged
from trade_gateway.ros._connect import join, planned
from trade_gateway.ros._file import RosFile, read_ros_file
from trade_gateway.ros.from_ros._joints import RosJoint

__all__ = ["Bridge", "Bridged", "RosFile", "join", "planned", "read_ros_file"]

_publish(__name__, Bridged, RosJoint)
