"""Conversion of time stamps of another clock to ours. Arithmetic only."""

from typing import Final

_DRIFT: Final = 0.001
"""The maximum rate difference of the clocks that does not make measurements appear older."""


class Age:
    """Estimates the offset of another clock from the time stamps of its measurements.

    The message with the least delay so far counts as measured on arrival. A lasting delay is forgotten at the maximum
    rate difference of the clocks: one of a second after a quarter of an hour.
    """

    def __init__(self) -> None:
        self._least_ns: int | None = None
        self._at_ns = 0

    def measured_ns(self, at_ns: int, stamp_ns: int) -> int:
        """Returns when a message was measured by our clock: it arrived at ``at_ns``, stamped ``stamp_ns``."""
        delay_ns = at_ns - stamp_ns
        if self._least_ns is None:
            self._least_ns = delay_ns
        self._least_ns = min(delay_ns, self._least_ns + int(_DRIFT * (at_ns - self._at_ns)))
        self._at_ns = at_ns
        return at_ns - (delay_ns - self._least_ns)
