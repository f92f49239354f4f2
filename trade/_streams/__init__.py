"""Streams: the source that samples and publishes, and the subscriber's buffer."""
