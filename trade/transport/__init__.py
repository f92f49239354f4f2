"""The transport: its base class, the implementation on eclipse-zenoh, and one in memory."""
