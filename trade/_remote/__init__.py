"""Starts containers on other hosts through ssh."""
