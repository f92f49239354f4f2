"""A ROS 1 system as a `Graph`: rospy runs in a child process under the distribution's own Python."""

from trade_gateway.ros.ros1._ros1 import Ros1

__all__ = ["Ros1"]
