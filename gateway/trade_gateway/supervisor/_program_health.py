"""How a program shows that it is up and healthy: the container that it opens, a command, or that it runs."""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Final

from trade import Container, Handle, where
from trade.errors import ConfigurationError
from trade_gateway.config._children import Child
from trade_gateway.supervisor._objects import GROUP, CreatedObjects

_LOOK_EVERY_S: Final = 0.05
_RUNS_S: Final = 1.0
"""How long a program without a sign of life runs before it counts as up, in seconds."""
_UP_S: Final = 50.0
"""How long a program may take to show its sign of life, in seconds; less than a start may take."""


def epochs_of(member: Container, child: Child) -> frozenset[str]:
    """Returns the boots of the announced container that are visible now: none of the next process."""
    name = child.part.entry.announces
    return frozenset(info.epoch for info in member.containers() if info.name == name) if name else frozenset()


def await_program(
    member: Callable[[], Container], child: Child, before: frozenset[str], gone: Callable[[], bool]
) -> CreatedObjects:
    """Waits until a program that was started shows that it is up.

    Args:
        member: returns the calling container.
        child: the program.
        before: boots of its container that are of earlier processes.
        gone: whether the process has ended, which ends the wait.

    Raises:
        ConfigurationError: it was not up in time.
    """
    entry, until, pause = child.part.entry, time.monotonic() + _UP_S, threading.Event()
    runs_at, problem = time.monotonic() + _RUNS_S, ""
    while not gone():
        if entry.announces:
            if (clock := _clock(member(), entry.announces, before)) is not None:
                return CreatedObjects(clock, {}, [])
            problem = f"container {entry.announces!r} was not visible within {_UP_S:g} s"
        elif entry.health is not None:
            if not (problem := health_problem(child)):
                return CreatedObjects(None, {}, [])
        elif time.monotonic() >= runs_at:
            return CreatedObjects(None, {}, [])
        if time.monotonic() > until:
            break
        pause.wait(_LOOK_EVERY_S)
    raise ConfigurationError(where=f"container.{child.name}", problem=problem or "it has ended")


def _clock(member: Container, name: str, before: frozenset[str]) -> Handle | None:
    found = member.services(where(name="clock", group=GROUP, container=name))
    return next((handle for handle in found if handle.key.address.epoch not in before), None)


def health_problem(child: Child) -> str:
    """Runs a program's health command; returns what is wrong, or an empty text."""
    health = child.part.entry.health
    if health is None:
        return ""
    try:
        process = subprocess.Popen(  # noqa: S603 - the file of the supervisor names it
            [child.part.health, *health.command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=child.part.folder,
            env=dict(child.environment),
            start_new_session=True,
        )
    except OSError as wrong:
        return f"its health command could not be started: {wrong.strerror}"
    try:
        code = process.wait(health.within_s)
    except subprocess.TimeoutExpired:
        return f"its health command took longer than {health.within_s:g} s"
    finally:
        _kill_group(process)
    return f"its health command ended with exit code {code}" if code else ""


def _kill_group(process: "subprocess.Popen[bytes]") -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):  # all of it has ended
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
