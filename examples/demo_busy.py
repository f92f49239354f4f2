"""Detects a computer too busy for the demo."""

import os
from typing import Final

_WAITING: Final = 1.5
"""With so many times more programs that want a processor than there are, each waits for its turn."""


def busy(load: float, cores: int) -> str:
    """What to say of a computer too busy for motion in time; empty if it is not.

    Args:
        load: its load average of the last minute.
        cores: processors that there are for programs.
    """
    if load < _WAITING * cores:
        return ""
    computer = f"this computer is busy (load {load:.0f} on {cores} core{'' if cores == 1 else 's'})"
    return f"{computer}; try again when it is not. trade itself is installed in .venv"


def busy_here() -> str:
    """The same of this computer, now."""
    try:
        return busy(os.getloadavg()[0], os.cpu_count() or 1)
    except OSError:  # this system has no load average
        return ""
