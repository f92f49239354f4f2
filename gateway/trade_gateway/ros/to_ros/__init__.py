"""What ROS has of TRADE: services, streams, joints, grippers and robots of TRADE in ROS."""
