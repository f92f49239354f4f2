"""Waiting for files, whatever their numbers, and for times that are told in less than milliseconds."""

import select
from collections.abc import Sequence
from typing import Final, Protocol, TypeVar

_FEW: Final = 1024
"""``select`` knows lower numbers only, and waits as briefly as it is told; ``poll`` rounds up to a millisecond."""


class _HasFile(Protocol):
    def fileno(self) -> int: ...


File = TypeVar("File", bound="int | _HasFile")


def ready(reading: Sequence[File], writing: Sequence[File] = (), timeout_s: float | None = None) -> list[File]:
    """Those of the first that can be read, or have ended, once there is one or one of the second can be written.

    Args:
        reading: files, or things that have one.
        writing: likewise.
        timeout_s: how long to wait, in seconds; None: as long as it takes.
    """
    numbers = {_number(thing): thing for thing in reading}
    wanted = dict.fromkeys(numbers, select.POLLIN)
    for thing in writing:
        number = _number(thing)
        wanted[number] = wanted.get(number, 0) | select.POLLOUT
    if timeout_s is not None and all(number < _FEW for number in wanted):
        to_write = [number for number, events in wanted.items() if events & select.POLLOUT]
        got = set(select.select(list(numbers), to_write, (), max(0.0, timeout_s))[0])
        return [thing for number, thing in numbers.items() if number in got]
    poll = select.poll()
    for number, events in wanted.items():
        poll.register(number, events)
    found = dict(poll.poll(None if timeout_s is None else max(0.0, timeout_s) * 1000))
    return [thing for number, thing in numbers.items() if found.get(number, 0) & ~select.POLLOUT]


def _number(thing: "int | _HasFile") -> int:
    return thing if isinstance(thing, int) else thing.fileno()
