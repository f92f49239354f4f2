"""Which samples of a source that may be faster one listener takes, and how many it has missed. Pure: no clock."""


class Pace:
    """At most so many a second, by the source's clock."""

    def __init__(self, hz: float) -> None:
        self._period_ns = int(1e9 / hz)
        self._slack_ns = self._period_ns // 2
        """A source is never quite on time: so much too early is on time, too."""
        self._due_ns: int | None = None
        self._number = 0

    def missed(self, number: int, at_ns: int) -> int:
        """How many that it would have taken are missing before this one, which has come now."""
        gap = number - self._number - 1 if self._number else 0
        self._number = number
        if gap <= 0 or self._due_ns is None:  # none is missing, or the source counts anew
            return 0
        return min(gap, max(0, (at_ns + self._slack_ns - self._due_ns) // self._period_ns))

    def takes(self, at_ns: int) -> bool:
        """Whether the sample of that moment is one of its own."""
        due_ns = at_ns if self._due_ns is None else self._due_ns
        if at_ns + self._slack_ns < due_ns:
            return False
        self._due_ns = max(due_ns, at_ns - self._period_ns) + self._period_ns
        return True
