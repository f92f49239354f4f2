"""Which samples of a source that may be faster are put at a lower rate. Pure: no clock."""


class Pace:
    """At most so many a second, by the source's clock."""

    def __init__(self, hz: float) -> None:
        self._period_ns = int(1e9 / hz)
        self._slack_ns = self._period_ns // 2
        """A source is never quite on time: so much too early is on time, too."""
        self._due_ns: int | None = None

    def takes(self, at_ns: int) -> bool:
        """Whether the sample of that moment is one of those."""
        due_ns = at_ns if self._due_ns is None else self._due_ns
        if at_ns + self._slack_ns < due_ns:
            return False
        self._due_ns = max(due_ns, at_ns - self._period_ns) + self._period_ns
        return True
