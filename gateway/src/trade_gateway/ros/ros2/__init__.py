"""ROS 2 by the key space of rmw_zenoh, without ROS 2; the facts stand in each module that relies on them."""

from trade_gateway.ros.ros2._ros2 import Ros2

__all__ = ["Ros2"]
