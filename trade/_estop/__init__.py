"""E-stops: the latch of a container, the broadcast until all confirm, what is kept on disk, and the deadman."""
