"""Planned motion: splines, checked plans, and joint groups over several buses."""
