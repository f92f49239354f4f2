"""ROS beside TRADE: topics, services, actions and joints of either, for the other."""

from trade_gateway.ros._bridge import Bridge, Bridged
from trade_gateway.ros._file import RosFile, read_ros_file
from trade_gateway.ros._joining import join, planned

__all__ = ["Bridge", "Bridged", "RosFile", "join", "planned", "read_ros_file"]
