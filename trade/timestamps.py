"""Times as text. Many come from other containers and may be invalid; formatting must not fail because of that."""

import time
from typing import Final

_NONE: Final = "?"


def clock(at: float, *, ms: bool = False) -> str:
    """The local time of day of a time in seconds since the epoch; ``?`` if it is invalid.

    Args:
        at: the time.
        ms: with milliseconds.
    """
    text = _written("%H:%M:%S", at)
    return f"{text}.{int(at % 1 * 1000):03d}" if ms and text != _NONE else text


def day_and_clock(at: float) -> str:
    """The same, preceded by the date."""
    return _written("%Y-%m-%d %H:%M:%S", at)


def _written(how: str, at: float) -> str:
    try:
        return time.strftime(how, time.localtime(at))
    except (OverflowError, ValueError, OSError):
        return _NONE
