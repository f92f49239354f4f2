"""The ROS 1 node of TRADE: a program under the Python that has rospy. It transfers bytes and knows no types."""
