"""How old a measurement is, although it says so by another clock. Arithmetic only."""

from typing import Final

__all__ = ["Age"]

_DRIFT: Final = 0.001
"""So much faster than ours the other clock may seem, before measurements seem to grow old by it."""


class Age:
    """Tells by our clock when things were measured that carry a time of another one.

    What came with the least delay so far counts as measured when it came. A delay that lasts is forgotten at the pace
    that the clocks may differ by: one of a second after a quarter of an hour.
    """

    def __init__(self) -> None:
        self._least_ns: int | None = None
        self._at_ns = 0

    def measured_ns(self, at_ns: int, theirs_ns: int) -> int:
        """When something was measured that came at ``at_ns`` by our clock, and says ``theirs_ns``."""
        delay_ns = at_ns - theirs_ns
        if self._least_ns is None:
            self._least_ns = delay_ns
        self._least_ns = min(delay_ns, self._least_ns + int(_DRIFT * (at_ns - self._at_ns)))
        self._at_ns = at_ns
        return at_ns - (delay_ns - self._least_ns)
