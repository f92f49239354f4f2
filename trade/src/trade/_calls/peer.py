"""Another container as callers see it: whether it is there, and how its clock runs against ours."""

import math
import time
from typing import Final

from trade._protocol.keys import Address

NEVER: Final = math.inf
_DRIFT: Final = 200e-6
"""Two monotonic clocks run apart at most this fast (quartz is specified to 100 ppm)."""


class Peer:
    """Another container as callers see it: whether it is there, and how its clock runs against ours."""

    def __init__(self, address: Address, *, lost: bool = False) -> None:
        self.address = address
        self.answers_on = f"reply/{address.identity}/"
        """How the keys of its answers begin."""
        self.lost = lost
        self._low_ns = -NEVER
        self._high_ns = NEVER
        self._at_ns = 0

    @property
    def clock_known(self) -> bool:
        return self._low_ns > -NEVER

    def heard(self, clock_ns: int, sent_ns: int, received_ns: int) -> None:
        """Its clock stood at ``clock_ns`` some time between our sending and our receiving."""
        slack = (received_ns - self._at_ns) * _DRIFT
        low = max(self._low_ns - slack, clock_ns - received_ns)
        high = min(self._high_ns + slack, clock_ns - sent_ns)
        if low > high:  # its clock or ours was set or stood still: what was known is void
            low, high = clock_ns - received_ns, clock_ns - sent_ns
        self._low_ns, self._high_ns, self._at_ns = low, high, received_ns

    def expiry_ns(self, deadline_ns: int) -> int | None:
        """Our deadline in its clock, never later than it is meant; None while the clock is unknown."""
        low, slack = self._low_ns, (time.monotonic_ns() - self._at_ns) * _DRIFT
        return int(deadline_ns + low - slack) if low > -NEVER else None
