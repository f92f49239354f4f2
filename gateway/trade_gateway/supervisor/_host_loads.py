"""Chooses the host to which a container moves when its own host is busy. No I/O, no clock."""

import math
from collections.abc import Collection
from typing import Final

_FRESH_S: Final = 10.0
"""How long a measured load counts, in seconds."""
_STEADY_S: Final = 5.0
"""How long a host is busy before a container leaves it, in seconds."""
_AGAIN_S: Final = 60.0
"""The shortest time between two moves, in seconds."""
_MARGIN: Final = 0.1
"""How much less the other host has to do, as a share of all its cores: a move is a short absence."""


class HostLoads:
    """The loads of the hosts that may have a container, as shares of all their cores."""

    def __init__(self) -> None:
        self._loads: dict[str, tuple[float, float]] = {}
        self._busy_since = math.inf
        self._again_at = -math.inf

    def note(self, host: str, load: float, now: float) -> None:
        """Keeps a measured load."""
        self._loads[host] = load, now

    def choice(self, here: str, others: Collection[str], above: float, now: float) -> str | None:
        """Returns the least loaded host to move to; None: the container stays.

        Args:
            here: the host that has the container.
            others: the hosts that can have it now.
            above: the load above which the host is busy.
            now: the time, in seconds.
        """
        known = {host: load for host, (load, at) in self._loads.items() if now - at <= _FRESH_S}
        if known.get(here, 0.0) <= above:
            self._busy_since = math.inf
            return None
        self._busy_since = min(self._busy_since, now)
        free = [host for host in others if host != here and known.get(host, math.inf) <= known[here] - _MARGIN]
        if not free or now - self._busy_since < _STEADY_S or now < self._again_at:
            return None
        least = min(free, key=lambda host: known[host])
        if known[least] > above:
            return None
        self._again_at = now + _AGAIN_S
        return least
