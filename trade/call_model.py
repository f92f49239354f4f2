"""Models of call sequences: which service is usually called after which, and calls that deviate from that."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Final, Literal

from msgspec import Struct

from trade._telemetry.spans import Span

_ENOUGH: Final = 20
"""The least count of an event before its rarity means anything."""
_RARER: Final = 4.0
"""How many times rarer than usual counts as a deviation."""
_MOST_SEQUENCES: Final = 1000
"""The number of sequences that are followed at the same time."""
_MOST_REPORTED: Final = 10_000
"""The number of different deviations that are reported."""

Pair = tuple[str, str]


class CallModel(Struct, frozen=True, forbid_unknown_fields=True):
    """A model of call sequences."""

    v: Literal[1]
    after: dict[str, dict[str, int]]
    """By service: how often each service was called after it."""

    def share(self, before: str, after: str) -> float:
        """The share of one service among all calls after another, from 0 to 1."""
        following = self.after.get(before, {})
        return following.get(after, 0) / (sum(following.values()) or 1)

    def count(self, before: str) -> int:
        """How often any call came after a service."""
        return sum(self.after.get(before, {}).values())


class CallDeviation(Struct, frozen=True, kw_only=True):
    """Two calls whose sequence deviates."""

    kind: Literal["new", "rarer"]
    before: str
    after: str
    usual: float
    """The learned share of ``after`` among the calls after ``before``, from 0 to 1."""
    now: float
    call_id: int
    """An example: a call of ``after``, or of the service called instead."""


class CallProfile(Struct, frozen=True, kw_only=True):
    """Call sequences of a container."""

    model: CallModel
    """Those of the calls that it made itself, as far as it still has spans of these."""
    watched: bool
    """Whether the container compares its calls with a model of what is usual."""
    deviations: list[CallDeviation]
    """What deviates from that model."""


def sequences(spans: Iterable[Span]) -> list[list[Span]]:
    """Sequences of calls in the order of their ends: those of each session, and those inside each call."""
    known: dict[int, Span] = {}
    for span in spans:
        if span.call_id not in known or span.side == "served":
            known[span.call_id] = span
    found: dict[str | int, list[Span]] = {}
    for span in sorted(known.values(), key=lambda one: (one.began + one.took_s, one.call_id)):
        found.setdefault(_sequence_of(span), []).append(span)
    return list(found.values())


def _sequence_of(span: Span) -> str | int:
    return span.calls[0] if span.calls else span.session


def _pairs(spans: Iterable[Span]) -> Iterable[tuple[Pair, int]]:
    for calls in sequences(spans):
        for before, after in pairwise(calls):
            yield (before.service, after.service), after.call_id


def learn(spans: Iterable[Span]) -> CallModel:
    """Learns a model from calls."""
    return _counted(_pairs(spans))


def _counted(pairs: Iterable[tuple[Pair, int]]) -> CallModel:
    model = CallModel(1, {})
    for (before, after), _ in pairs:
        following = model.after.setdefault(before, {})
        following[after] = following.get(after, 0) + 1
    return model


def deviations(spans: Iterable[Span], usual: CallModel) -> list[CallDeviation]:
    """Sequences that are new, and frequent ones that are now at most a quarter as frequent as usual."""
    pairs = list(_pairs(spans))
    now, example = _counted(pairs), dict(pairs)
    latest = {before: call_id for (before, _), call_id in pairs}

    def deviation(kind: Literal["new", "rarer"], before: str, after: str) -> CallDeviation:
        return CallDeviation(
            kind=kind,
            before=before,
            after=after,
            usual=usual.share(before, after),
            now=now.share(before, after),
            call_id=example.get((before, after), latest[before]),
        )

    new = [deviation("new", *pair) for pair in sorted(example) if usual.share(*pair) == 0]
    known = [
        (before, after)
        for before, following in sorted(usual.after.items())
        if min(usual.count(before), now.count(before)) >= _ENOUGH
        for after in sorted(following)
    ]
    return new + [deviation("rarer", *pair) for pair in known if _much_rarer(usual, now, pair)]


def _much_rarer(usual: CallModel, now: CallModel, pair: Pair) -> bool:
    """Whether a sequence is much rarer than usual, with enough calls to tell."""
    was = usual.share(*pair)
    return was * now.count(pair[0]) >= _RARER and now.share(*pair) * _RARER <= was


def made_here(span: Span) -> bool:
    """Whether the container that recorded a call also made it; it knows the sequences of these completely."""
    return span.side == "asked" or not span.remote


class CallWatch:
    """Reports each pair of calls that a container makes and that its model does not have, once."""

    def __init__(self, usual: CallModel, callback: Callable[[str, str, int], None]) -> None:
        self.usual: Final = usual
        """The model."""
        self._tell = callback
        """Called with the service before, the service after, and the id of its call."""
        self._lock = threading.Lock()
        self._last: OrderedDict[str | int, str] = OrderedDict()
        """The last service of each sequence."""
        self._reported: set[Pair] = set()

    def see(self, span: Span) -> None:
        """Take a call that has ended."""
        if not made_here(span):
            return
        sequence, after = _sequence_of(span), span.service
        with self._lock:
            before = self._last.pop(sequence, None)
            self._last[sequence] = after
            if len(self._last) > _MOST_SEQUENCES:
                self._last.popitem(last=False)
            if before is None or self.usual.share(before, after) > 0 or (before, after) in self._reported:
                return
            if len(self._reported) >= _MOST_REPORTED:
                return
            self._reported.add((before, after))
        self._tell(before, after, span.call_id)
