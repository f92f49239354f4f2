"""The ROS 1 node of TRADE: a program under the Python that has rospy. It carries bytes and knows no types."""
