"""Which call usually comes after which: counted in what was noted, written to a file, compared with one."""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec import Struct

from trade import Span
from trade.errors import ConfigurationError
from trade_gateway.process._atomic_file import replace

_ENOUGH: Final = 20
"""So often something must have happened before its being rare means anything."""
_RARER: Final = 4.0
"""So many times rarer than usual deviates."""

Pair = tuple[str, str]


class Model(Struct, forbid_unknown_fields=True):
    """How often each service was called after each other one."""

    v: Literal[1]
    after: dict[str, dict[str, int]]

    def share(self, before: str, after: str) -> float:
        """How much of what came after the one was the other."""
        following = self.after.get(before, {})
        return following.get(after, 0) / (sum(following.values()) or 1)

    def count(self, before: str) -> int:
        """How often anything came after it."""
        return sum(self.after.get(before, {}).values())


class Deviation(Struct, frozen=True, kw_only=True):
    """A sequence that is not as usual."""

    kind: Literal["new", "rarer"]
    before: str
    after: str
    usual: float
    """Its share in what came after ``before``, from 0 to 1, when that was learned."""
    now: float
    call_id: int
    """An example: a call of ``after``, or of what came in its place."""


def sequences(spans: Iterable[Span]) -> list[list[Span]]:
    """Calls in order: those of one session that nothing led to, and those that one call made."""
    known: dict[int, Span] = {}
    for span in spans:
        if span.call_id not in known or span.side == "served":
            known[span.call_id] = span
    found: dict[str | int, list[Span]] = {}
    for span in sorted(known.values(), key=lambda one: (one.began, one.call_id)):
        found.setdefault(span.calls[0] if span.calls else span.session, []).append(span)
    return list(found.values())


def _pairs(spans: Iterable[Span]) -> Iterable[tuple[Pair, int]]:
    for calls in sequences(spans):
        for before, after in pairwise(calls):
            yield (before.service, after.service), after.call_id


def learn(spans: Iterable[Span]) -> Model:
    """What was usual."""
    return _counted(_pairs(spans))


def _counted(pairs: Iterable[tuple[Pair, int]]) -> Model:
    model = Model(1, {})
    for (before, after), _ in pairs:
        following = model.after.setdefault(before, {})
        following[after] = following.get(after, 0) + 1
    return model


def deviations(spans: Iterable[Span], usual: Model) -> list[Deviation]:
    """What never came before, and what comes at most a quarter as often as it did, if both are counted enough."""
    pairs = list(_pairs(spans))
    now, example = _counted(pairs), dict(pairs)
    latest = {before: call_id for (before, _), call_id in pairs}

    def deviation(kind: Literal["new", "rarer"], before: str, after: str) -> Deviation:
        return Deviation(
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


def _much_rarer(usual: Model, now: Model, pair: Pair) -> bool:
    """If it were as usual, it would have been seen several times by now."""
    was = usual.share(*pair)
    return was * now.count(pair[0]) >= _RARER and now.share(*pair) * _RARER <= was


def write(path: Path, model: Model) -> None:
    """Raises ConfigurationError: it cannot be written."""
    try:
        replace(path.resolve(), msgspec.json.format(msgspec.json.encode(model), indent=2) + b"\n", 0o644)
    except OSError as problem:
        raise ConfigurationError(where=str(path), problem=str(problem)) from None


def read(path: Path) -> Model:
    """Raises ConfigurationError: it cannot be read, or is no such file."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Model)
    except (OSError, msgspec.DecodeError) as problem:
        raise ConfigurationError(where=str(path), problem=str(problem)) from None
