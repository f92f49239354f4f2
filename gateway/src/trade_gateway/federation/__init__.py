"""The gateway's containers in other systems."""
