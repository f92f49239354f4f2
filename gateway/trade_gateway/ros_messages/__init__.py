"""Messages of ROS: their definitions, and their conversion to the values of services and back."""
