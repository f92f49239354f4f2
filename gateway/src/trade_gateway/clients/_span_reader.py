"""Calls of the whole system as they end, from what its containers note of them while they are traced."""

from typing import Final

from trade import Container, Handle, Span, where
from trade.errors import AccessDenied

_MOST: Final = 200
"""Of what was noted before anybody asked."""


class CallReader:
    """Reads on where it was: each call once, or twice if who called and who served it are both traced.

    Args:
        container: of whose system.
        reads: also calls of services that only read.
    """

    def __init__(self, container: Container, *, reads: bool) -> None:
        self._container = container
        self._reads = reads
        self._read: dict[Handle, int] = {}
        """By what tells of a container's calls, the number of the last one told."""

    def read(self) -> list[Span]:
        """What has ended since the last time, in the order in which it began; the first time the newest 200.

        Raises:
            AccessDenied: the policy does not let this container read group ``trade``.
        """
        handles, first = self._container.services(where(name="spans", group="trade")), not self._read
        reading = [] if self._reads else [one for one in self._container.services() if one.effect == "read"]
        left_out = {one.label for one in reading}
        new: list[Span] = []
        for outcome in self._container.call_all([one.bind(None, self._read.get(one, 0)) for one in handles]):
            if isinstance(outcome.error, AccessDenied):
                raise outcome.error
            if not outcome.ok:  # it has left meanwhile
                continue
            spans: list[Span] = outcome.result
            self._read[outcome.handle] = spans[-1].number if spans else self._read.get(outcome.handle, 0)
            new += [span for span in spans if span.service not in left_out]
        new.sort(key=lambda span: (span.began, span.call_id))
        return new[-_MOST:] if first else new
