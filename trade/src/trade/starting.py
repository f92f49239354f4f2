"""Starts programs on other hosts through ``ssh``, for tools that start a whole system: ``trade system up``."""

from trade._remote.ssh import LONGEST_S, Started, end_there, launch, missing_there

__all__ = ["LONGEST_S", "Started", "end_there", "launch", "missing_there"]
