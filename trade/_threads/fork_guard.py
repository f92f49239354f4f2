"""Process-wide rules: containers end with their process, and do not survive a fork."""

import atexit
import os
import weakref
from typing import Protocol

from trade.errors import ConfigurationError


class _Container(Protocol):
    def close(self) -> None: ...
    def abandon(self) -> None: ...


live: "weakref.WeakSet[_Container]" = weakref.WeakSet()
"""The running containers."""
_started = False
_forked = False


@atexit.register
def _close_all() -> None:
    """The interpreter must not end under threads that wait inside the transport."""
    for container in list(live):
        container.close()


def note_start() -> None:
    """Records that a container starts: from now on a fork of this process cannot have containers."""
    global _started  # noqa: PLW0603 - a fact about the process: the transport's runtime stays for good
    _started = True


def forked() -> bool:
    """Whether this process was forked from one that had a container."""
    return _forked


def refuse_after_fork() -> None:
    """Raises ConfigurationError in a process that was forked from one that had a container."""
    if _forked:
        problem = (
            "this process was forked from one that had a container, which cannot work; start it with spawn, not fork"
        )
        raise ConfigurationError(problem=problem)


def _after_fork() -> None:
    global _forked  # noqa: PLW0603 - a fact about the process
    _forked = _forked or _started
    for container in list(live):
        container.abandon()
    live.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
