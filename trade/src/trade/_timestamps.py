"""Moments in words. Many come from others, who may tell anything, and an error must never fail to say what it is."""

import time
from typing import Final

__all__ = ["clock", "day_and_clock"]

_NONE: Final = "?"


def clock(at: float, *, ms: bool = False) -> str:
    """The time of day here of a moment in seconds since the epoch; ``?`` if there is no such moment.

    Args:
        at: the moment.
        ms: with milliseconds.
    """
    text = _written("%H:%M:%S", at)
    return f"{text}.{int(at % 1 * 1000):03d}" if ms and text != _NONE else text


def day_and_clock(at: float) -> str:
    """The same with the date before it."""
    return _written("%Y-%m-%d %H:%M:%S", at)


def _written(how: str, at: float) -> str:
    try:
        return time.strftime(how, time.localtime(at))
    except (OverflowError, ValueError, OSError):
        return _NONE
