"""The samples of one rate: which are due, and their publication."""

from typing import Final, NamedTuple

from msgspec import Raw

from trade.protocol.messages import PROTOCOL, encode_message
from trade.protocol.samples import StreamSample
from trade.transport.base import Publisher

SIGN_S: Final = 1.0
"""An unchanged value is still published this often."""


class Pace:
    """A rate limit, by the source's clock."""

    def __init__(self, hz: float) -> None:
        self._period_ns = int(1e9 / hz)
        self._slack_ns = self._period_ns // 2
        """A source is never exactly on time: a sample this much too early counts as on time."""
        self._due_ns: int | None = None

    def takes(self, at_ns: int) -> bool:
        """Whether a sample of that time is within the rate."""
        due_ns = at_ns if self._due_ns is None else self._due_ns
        if at_ns + self._slack_ns < due_ns:
            return False
        self._due_ns = max(due_ns, at_ns - self._period_ns) + self._period_ns
        return True


class ActiveRate(NamedTuple):
    """The combined requests for one rate."""

    always: bool
    """Some listener wants more than changes."""
    newly: bool
    """Some listener wants a sample now."""


def period_ns(hz: float) -> int:
    """The period of a rate."""
    return int(1e9 / hz)


class Rate:
    """The publication of samples at one rate. Used by the scheduler only."""

    def __init__(self, hz: float, publisher: Publisher) -> None:
        self._pace = Pace(hz)
        self._publisher = publisher
        self._period_ns = period_ns(hz)
        self._number = 0
        self._put: tuple[bool, bytes] | None = None
        self._put_ns = 0

    def offer(self, answer: tuple[bool, bytes], at: float, at_ns: int, requested: ActiveRate, every_ns: int) -> None:
        """Publish a sample, unless it is too soon, or unchanged for listeners of changes only.

        Args:
            answer: whether the service failed, and its result.
            at: ``time.time()`` of the call.
            at_ns: the monotonic clock at that moment.
            requested: the requests for this rate.
            every_ns: the period of sampling.
        """
        stale = at_ns - self._put_ns >= SIGN_S * 1e9
        if not (requested.newly or stale or requested.always or answer != self._put):
            return
        on_time = every_ns >= self._period_ns or self._pace.takes(at_ns)
        if not (requested.newly or on_time):
            return
        self._number += 1
        self._publisher.put(encode_message(StreamSample(PROTOCOL, self._number, at, at_ns, answer[0], Raw(answer[1]))))
        self._put, self._put_ns = answer, at_ns

    def close(self) -> None:
        self._publisher.close()
