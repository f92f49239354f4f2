"""Tracks the revisions of one container, in announcements and replies, to detect missed announcements."""


class RevisionTracker:
    """Knows whether announcements of one container are missing, by the revisions in its messages.

    A container announces single changes, and replies with all of its entries at once. Nothing is missing if the newest
    reply reaches the beginning of the unbroken run of announcements. A run from the very first announcement to the
    container's own count of them needs no reply.
    """

    __slots__ = ("_first", "_last", "answered")

    def __init__(self) -> None:
        self.answered = -1
        """The revision of its newest reply; -1 before the first."""
        self._first = 1
        self._last = 0

    @property
    def complete(self) -> bool:
        """Whether everything is known up to the highest revision heard of."""
        return self.answered >= self._first - 1

    def reopen(self) -> None:
        """Nothing counts as known completely until the next reply."""
        self.answered = -1
        self._first = self._last + 1

    def announced(self, revision: int) -> None:
        """An announcement of a revision has arrived."""
        if revision > self._last + 1:
            self._first = revision
        self._last = max(self._last, revision)

    def counted(self, revision: int) -> None:
        """The container reports its current revision."""
        if revision > self._last:
            self._first, self._last = revision + 1, revision
        elif self._first == 1:
            self.answered = max(self.answered, 0)

    def replied(self, revision: int) -> None:
        """It replied with everything at a revision."""
        self.answered = max(self.answered, revision)
        self.counted(revision)
