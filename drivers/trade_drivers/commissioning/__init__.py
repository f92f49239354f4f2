"""Scanning a bus for devices, and setting their ids and baud rates."""
