"""ROS 2 over the key space of rmw_zenoh, without an installation of ROS 2; each module lists the facts it uses."""

from trade_gateway.ros.ros2._ros2 import Ros2

__all__ = ["Ros2"]
