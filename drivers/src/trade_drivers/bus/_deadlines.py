"""What a service makes of the call that asks for it: until when it may begin, and until when it may last."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Final, NamedTuple

from trade import Permit, Resource, current_call, permit

__all__ = ["Terms", "admitted", "at_once", "expiry", "span"]

_DEFAULT_EXPIRY_NS: Final = 1_000_000_000
"""How long a plain Python call may wait for its turn on the bus."""
_ANSWER_NS: Final = 100_000_000
"""For one exchange (48 ms at most), the hold, and the way back to the caller."""


class Terms(NamedTuple):
    """The terms on which a command was admitted."""

    service: str
    """The one that was called."""
    expires_ns: int
    """When it may begin at the latest."""
    until_ns: int | None
    """When it is ended if it is not over."""
    permit: Permit


@contextmanager
def admitted(
    service: str, resources: Sequence[Resource], times: tuple[int, int | None]
) -> Generator[Terms, None, None]:
    """The terms of a command, under a permit for what it moves."""
    with permit(resources) as permitted:
        yield Terms(service, *times, permitted)


def at_once(clock: Callable[[], int]) -> tuple[int, None]:
    """When a command without an end may begin at the latest."""
    return expiry(clock)[0], None


def expiry(clock: Callable[[], int]) -> tuple[int, bool]:
    """When it may begin at the latest, and whether it must be over then: a plain Python call ends when it ends."""
    call = current_call()
    if call is None or call.expires_ns is None:
        return clock() + _DEFAULT_EXPIRY_NS, False
    return call.expires_ns, True


def span(clock: Callable[[], int]) -> tuple[int, int | None]:
    """When a motion with an end may begin at the latest, and when it is ended if it is not over.

    That is somewhat before the deadline of its call, so that the caller is told that it was stopped: stopped at the
    deadline itself, the answer would come when nobody waits for it any more.
    """
    expires_ns, ends = expiry(clock)
    if not ends:
        return expires_ns, None
    expires_ns -= min(_ANSWER_NS, max(0, expires_ns - clock()) // 5)
    return expires_ns, expires_ns
