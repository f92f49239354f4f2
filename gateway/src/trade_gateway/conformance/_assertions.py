"""What a check says: that a rule is not held, or that something does not happen in time."""

import threading
import time
from collections.abc import Callable
from typing import Final

PATIENCE_S: Final = 10.0
"""How long anything may take that has no limit of its own."""
STOPPED_S: Final = 2.0
"""What moves comes to rest within this (S05)."""
SLACK_S: Final = 3.0
"""What the suite allows itself, on a busy machine, for saying so and seeing it."""
_LOOK_S: Final = 0.02


class NotHeld(Exception):
    """The container under test does not do what the page says."""


def require(holds: object, otherwise: str) -> None:
    """Raises NotHeld unless it holds."""
    if not holds:
        raise NotHeld(otherwise)


def eventually(holds: Callable[[], object], otherwise: str, within_s: float = PATIENCE_S) -> None:
    """Look until it holds; raises NotHeld if it does not within that time, in seconds."""
    until = time.monotonic() + within_s
    while not holds():
        require(time.monotonic() < until, f"{otherwise} within {within_s:g} s")
        threading.Event().wait(_LOOK_S)
