"""Assertions of the checks: that a rule is followed, or that something happens in time."""

import threading
import time
from collections.abc import Callable
from typing import Final

PATIENCE_S: Final = 10.0
"""Time limit of everything that has no limit of its own, in seconds."""
STOPPED_S: Final = 2.0
"""Time in which a moving arm must come to rest (S05), in seconds."""
SLACK_S: Final = 3.0
"""Extra time for the suite's own messages on a busy machine, in seconds."""
_LOOK_S: Final = 0.02


class NotHeld(Exception):
    """The container under test breaks a rule of the page."""


def require(holds: object, otherwise: str) -> None:
    """Raises NotHeld if the condition is false."""
    if not holds:
        raise NotHeld(otherwise)


def eventually(holds: Callable[[], object], otherwise: str, within_s: float = PATIENCE_S) -> None:
    """Polls until the condition is true; raises NotHeld if it stays false for that time, in seconds."""
    until = time.monotonic() + within_s
    while not holds():
        require(time.monotonic() < until, f"{otherwise} within {within_s:g} s")
        threading.Event().wait(_LOOK_S)
