"""Simulated buses out of a robot file, and the thread that each of them has."""
