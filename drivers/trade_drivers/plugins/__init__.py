"""Drivers as plug-ins: the base class, entry points, and what a driver checks before it opens a port."""
