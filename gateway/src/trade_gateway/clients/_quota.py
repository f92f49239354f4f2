"""How much may be under way at once, of one and of all."""

import threading
from collections import Counter
from collections.abc import Callable
from typing import Final

from trade_gateway.clients._errors import TooMany

MOST: Final = 64
MOST_OF_ONE: Final = 16


class Quota:
    """Calls and requests for locks that have not ended; stops are not among them (S07)."""

    def __init__(self) -> None:
        self._under_way: Counter[str] = Counter()
        self._guard = threading.Lock()

    def take(self, who: str) -> Callable[[], None]:
        """One more; returns what is to be called once when it has ended, on any thread. Raises TooMany."""
        with self._guard:
            if sum(self._under_way.values()) >= MOST:
                raise TooMany(what="calls under way", limit=MOST)
            if self._under_way[who] >= MOST_OF_ONE:
                raise TooMany(what=f"calls of {who} under way", limit=MOST_OF_ONE)
            self._under_way[who] += 1
        return lambda: self._ended(who)

    def _ended(self, who: str) -> None:
        with self._guard:
            self._under_way[who] -= 1
            if not self._under_way[who]:
                del self._under_way[who]
