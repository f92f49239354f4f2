"""Starts programs on other hosts through ``ssh``, and packs code for them: for tools that start a whole system."""

from trade._migration.delivered_code import hash_of, pack
from trade._remote.ssh import LONGEST_S, Started, end_there, launch, missing_there

__all__ = ["LONGEST_S", "Started", "end_there", "hash_of", "launch", "missing_there", "pack"]
