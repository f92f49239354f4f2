"""What a service makes of the call that asks for it: until when it may begin, and until when it may last."""

from collections.abc import Callable
from typing import Final

from trade import current_call

__all__ = ["expiry", "span"]

_DEFAULT_EXPIRY_NS: Final = 1_000_000_000
"""How long a plain Python call may wait for its turn on the bus."""
_ANSWER_NS: Final = 100_000_000
"""For one exchange (48 ms at most), the hold, and the way back to the caller."""


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
