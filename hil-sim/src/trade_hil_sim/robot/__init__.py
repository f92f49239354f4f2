"""Simulated buses out of a robot file."""
