"""ROS beside TRADE: topics, services, actions and joints of either, for the other."""
