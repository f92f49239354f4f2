"""Measurements of a container: spans, metrics, log lines, and load."""
