"""Simulated buses of a robot file, each with its own thread."""
