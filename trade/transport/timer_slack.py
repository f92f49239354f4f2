"""The timer slack of threads: by how much later than asked Linux may end a timed wait (prctl(2), PR_SET_TIMERSLACK)."""

import ctypes
import sys
from collections.abc import Callable
from typing import Final, TypeVar

_T = TypeVar("_T")
_PR_SET_TIMERSLACK: Final = 29
_SLACK_NS: Final = 1_000_000_000
_AS_IT_WAS: Final = 0
"""Sets the slack of a thread back to what it was when the thread began."""
_prctl: Final = ctypes.PyDLL(None).prctl if sys.platform == "linux" else None
"""It takes 0.4 us, for which releasing the interpreter is not worthwhile."""


def read_patiently(recv: Callable[[], _T]) -> _T:
    """Call a function that waits for a message; a message wakes the thread at once, and nothing else does so often.

    `recv` of zenoh's channels wakes ten times a second to look for signals, which only the main thread receives. In an
    idle container, that took six threads 0.2 % of a core.
    """
    if _prctl is None:
        return recv()
    _prctl(_PR_SET_TIMERSLACK, _SLACK_NS)
    try:
        return recv()
    finally:  # what the thread does with the message may have deadlines
        _prctl(_PR_SET_TIMERSLACK, _AS_IT_WAS)
