"""What TRADE has of ROS: services, topics, actions and joints of ROS as providers."""
