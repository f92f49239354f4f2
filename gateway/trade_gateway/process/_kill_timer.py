"""Kernel timers that end this process at a given time, even while it is frozen."""

import ctypes
import os
import signal
import time
from typing import Final, NamedTuple

from trade.errors import ConfigurationError

_AT: Final = 1
"""TIMER_ABSTIME of time.h."""


class TimerLease(NamedTuple):
    """How long a process may run, in seconds of `uptime_s`, the same clock for all processes of a host."""

    leave_at: float
    """When it gets SIGTERM, to shut down in order."""
    until: float
    """When it gets SIGKILL."""

    def line(self) -> str:
        """Returns it as a line for `read`."""
        return f"{self.leave_at:.6f} {self.until:.6f}"

    @classmethod
    def read(cls, line: str) -> "TimerLease":
        """Parses a line. Raises ValueError."""
        leave_at, until = line.split()
        return cls(float(leave_at), float(until))


def uptime_s() -> float:
    """Returns the seconds since this host was started, including those in suspension."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class KillTimer:
    """Timers that send this process SIGTERM, and later SIGKILL, unless they are postponed.

    Raises:
        ConfigurationError: this system has no such timers.
    """

    def __init__(self, term: TimerLease) -> None:
        self._leave = _timer(signal.SIGTERM)
        self._end = _timer(signal.SIGKILL)
        self.move(term)

    def move(self, term: TimerLease) -> None:
        """Sets new times; a time in the past means now."""
        _set(self._end, term.until)
        _set(self._leave, term.leave_at)


class _Event(ctypes.Structure):
    """``struct sigevent``; with zeros behind, it asks for a signal to the process."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("pad", ctypes.c_byte * 48),
    )


class _Times(ctypes.Structure):
    """``struct itimerspec``."""

    _fields_ = (
        ("again_s", ctypes.c_long),
        ("again_ns", ctypes.c_long),
        ("first_s", ctypes.c_long),
        ("first_ns", ctypes.c_long),
    )


_libc: Final = ctypes.CDLL(None, use_errno=True)


def _timer(number: int) -> ctypes.c_void_p:
    timer, event = ctypes.c_void_p(), _Event(None, number, 0)
    if _libc.timer_create(time.CLOCK_BOOTTIME, ctypes.byref(event), ctypes.byref(timer)):
        raise _refused()
    return timer


def _set(timer: ctypes.c_void_p, at_s: float) -> None:
    whole = int(at_s)
    times = _Times(0, 0, whole, max(1, int((at_s - whole) * 1e9)))  # all zero would be: never
    if _libc.timer_settime(timer, _AT, ctypes.byref(times), None):
        raise _refused()


def _refused() -> ConfigurationError:
    why = os.strerror(ctypes.get_errno())
    return ConfigurationError(where="--leased", problem=f"this system has no timer that ends a process: {why}")
