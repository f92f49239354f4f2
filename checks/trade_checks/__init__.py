"""Checks of whole systems: drills on simulated robots, and conformance of containers in any language."""
