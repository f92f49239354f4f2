"""Which firing of a rule may have brought about which: how rules that trigger each other for ever are found out.

Nobody tells why a service left. So it is a guess by time: what happens while a rule's steps run, or shortly after, may
be their doing. Coincidences happen; a rule is stopped only when it has come back to itself several times over.
"""

import threading
from collections import deque
from typing import Final, NamedTuple

AFTERMATH_NS: Final = 5_000_000_000
"""What steps bring about shows within so long."""
TURNS: Final = 3
"""So often a rule may be among the causes of its own firing."""
_MOST: Final = 1000
_LONGEST: Final = 64


class Mark(NamedTuple):
    """A rule, and the service it fired about, if any."""

    rule: str
    service: str = ""


Way = tuple[Mark, ...]
"""What led to a firing, the first cause first; it comes last."""


class Past:
    """A firing that is under way or over."""

    def __init__(self, way: Way) -> None:
        self.way: Final = way
        self.ended_ns: int | None = None


class LoopDetector:
    """Remembers the latest firings of all rules of an engine."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._past: deque[Past] = deque(maxlen=_MOST)

    def begin(self, way: Way) -> Past:
        """A rule fires; whoever says so sets ``ended_ns`` when that is over."""
        past = Past(way)
        with self._lock:
            self._past.append(past)
        return past

    def forget(self, rule: str) -> None:
        """It begins anew: what it did before leads to nothing any more."""
        with self._lock:
            kept = [past for past in self._past if all(mark.rule != rule for mark in past.way)]
            self._past = deque(kept, maxlen=_MOST)

    def way_to(self, mark: Mark, since_ns: int) -> Way:
        """What may have led to an occasion that came about between then and now, and the occasion."""
        with self._lock:
            latest = list(reversed(self._past))
        ways = [past.way for past in latest if past.ended_ns is None or past.ended_ns + AFTERMATH_NS >= since_ns]
        before = max(ways, key=lambda way: way.count(mark), default=())
        return (*before, mark)[-_LONGEST:]


def turns(way: Way) -> int:
    """How often the last of a way stands in it before."""
    return way[:-1].count(way[-1]) if way else 0
