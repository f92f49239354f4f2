"""What carries bytes: the base class, its implementation on eclipse-zenoh, and one in memory."""
