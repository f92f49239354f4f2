"""Configuration files: the gateway file, and the tables of containers."""
