"""Containers started on other hosts through ssh."""
