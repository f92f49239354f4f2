"""The retry budget of an exchange on a line of requests and answers."""

from collections.abc import Callable, Iterator
from typing import Final

ATTEMPTS: Final = 3


def attempts(clock: Callable[[], int], patience_ns: int) -> Iterator[int]:
    """Yields the number of each attempt, from 0: three, and more while the first one began less than this ago.

    So a device has as long to answer as its measurements may be old: where the other end is slow, all answers are late.
    """
    began_ns, number = clock(), 0
    while number < ATTEMPTS or clock() - began_ns < patience_ns:
        yield number
        number += 1
