"""What a service makes of the call that asks for it: until when it may begin, and whether its numbers are numbers."""

from collections.abc import Callable
from math import isfinite
from typing import Final

from trade import current_call
from trade.errors import InvalidArgument

__all__ = ["expiry", "finite", "time_to_answer_ns"]

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


def time_to_answer_ns(left_ns: int) -> int:
    """How long before its call's deadline a move ends, so that the caller is told that the joint was stopped.

    Stopped at the deadline itself, the answer would come when nobody waits for it any more.
    """
    return min(_ANSWER_NS, max(0, left_ns) // 5)


def finite(value: float, service: str, argument: str) -> float:
    """The number.

    Raises:
        InvalidArgument: it is none.
    """
    if not isinstance(value, int | float) or isinstance(value, bool) or not isfinite(value):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise InvalidArgument(service=service, argument=argument, problem=f"{value!r} is not a finite number")
    return float(value)
