"""Whether anything that a container announced was missed: its revisions, as they are heard and as it answers."""

__all__ = ["RevisionTracker"]


class RevisionTracker:
    """What is heard of one container comes in two ways: announcements one by one, and answers that tell all at once.

    Nothing is missing if the newest answer reaches up to where the unbroken run of announcements begins.
    """

    __slots__ = ("_first", "_last", "answered")

    def __init__(self) -> None:
        self.answered = -1
        """The revision of its newest answer; -1 before there is one."""
        self._first = 1
        self._last = 0

    @property
    def complete(self) -> bool:
        """Whether all is known up to the highest revision heard of."""
        return self.answered >= self._first - 1

    def told(self, revision: int) -> None:
        """One thing was announced."""
        if revision > self._last + 1:
            self._first = revision
        self._last = max(self._last, revision)

    def counted(self, revision: int) -> None:
        """So much has been announced, it says."""
        if revision > self._last:
            self._first, self._last = revision + 1, revision

    def all_told(self, revision: int) -> None:
        """It answered with all that stood at a revision."""
        self.answered = max(self.answered, revision)
        self.counted(revision)
