"""A bridge between TRADE and ROS: topics, services, actions and joints of each side, offered on the other."""

from typing import TYPE_CHECKING

from trade_gateway._lazy_names import lazy_names

if TYPE_CHECKING:
    from trade_gateway.ros._bridge import Bridge, BridgeMappings
    from trade_gateway.ros._connect import join, planned
    from trade_gateway.ros._file import RosFile, read_ros_file

__all__ = ["Bridge", "BridgeMappings", "RosFile", "join", "planned", "read_ros_file"]

# their modules need the extra `ros`, which the command line is installed without
__getattr__ = lazy_names(
    __name__,
    {
        "Bridge": "_bridge",
        "BridgeMappings": "_bridge",
        "join": "_connect",
        "planned": "_connect",
        "RosFile": "_file",
        "read_ros_file": "_file",
    },
)
