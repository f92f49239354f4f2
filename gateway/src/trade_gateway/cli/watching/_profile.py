"""``trade profile``: shows counts and durations of calls, and deviations from a learned model."""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
import typer
from msgspec import Struct
from rich.markup import escape

from trade import Span
from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import visitor_among_others
from trade_gateway.cli.watching._trace import Name
from trade_gateway.process._atomic_file import replace

_ENOUGH: Final = 20
"""The least count of an event before its rarity means anything."""
_RARER: Final = 4.0
"""How many times rarer than usual counts as a deviation."""

Pair = tuple[str, str]


class Model(Struct, forbid_unknown_fields=True):
    """A model of call sequences: how often each service was called after each other one."""

    v: Literal[1]
    after: dict[str, dict[str, int]]

    def share(self, before: str, after: str) -> float:
        """Returns the share of one service among all calls after another."""
        following = self.after.get(before, {})
        return following.get(after, 0) / (sum(following.values()) or 1)

    def count(self, before: str) -> int:
        """Returns how often any call came after a service."""
        return sum(self.after.get(before, {}).values())


class Deviation(Struct, frozen=True, kw_only=True):
    """A sequence of two calls that deviates from the model."""

    kind: Literal["new", "rarer"]
    before: str
    after: str
    usual: float
    """The learned share of ``after`` among the calls after ``before``, from 0 to 1."""
    now: float
    call_id: int
    """An example: a call of ``after``, or of the service called instead."""


def sequences(spans: Iterable[Span]) -> list[list[Span]]:
    """Returns sequences of calls: the top-level calls of each session, and the calls inside each call."""
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
    """Learns a model from calls."""
    return _counted(_pairs(spans))


def _counted(pairs: Iterable[tuple[Pair, int]]) -> Model:
    model = Model(1, {})
    for (before, after), _ in pairs:
        following = model.after.setdefault(before, {})
        following[after] = following.get(after, 0) + 1
    return model


def deviations(spans: Iterable[Span], usual: Model) -> list[Deviation]:
    """Returns sequences that are new, and frequent ones that are now at most a quarter as frequent as usual."""
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
    """Whether a sequence is much rarer than usual, with enough calls to tell."""
    was = usual.share(*pair)
    return was * now.count(pair[0]) >= _RARER and now.share(*pair) * _RARER <= was


def write(path: Path, model: Model) -> None:
    """Writes a model. Raises ConfigurationError."""
    try:
        replace(path.resolve(), msgspec.json.format(msgspec.json.encode(model), indent=2) + b"\n", 0o644)
    except OSError as problem:
        raise ConfigurationError(where=str(path), problem=str(problem)) from None


def read(path: Path) -> Model:
    """Reads a model. Raises ConfigurationError."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Model)
    except (OSError, msgspec.DecodeError) as problem:
        raise ConfigurationError(where=str(path), problem=str(problem)) from None


class Statistics(Struct, frozen=True, kw_only=True):
    """Statistics of the calls of one service."""

    service: str
    calls: int
    errors: int
    p50_s: float
    p99_s: float
    max_s: float
    callers: tuple[str, ...]


def profile(
    context: typer.Context,
    learn_file: Annotated[Path | None, typer.Option("--learn", help="File to write what is usual to.")] = None,
    against: Annotated[Path | None, typer.Option(help="File to compare with; exit code 1 if calls deviate.")] = None,
    container: Name = "*",
    as_json: Json = False,
) -> None:
    """Show how often services were called, and how long they took.

    Only traced calls count, so run `trade tracing on` first.
    --learn records, for each service, what the same caller called next.

    For example: trade profile --learn usual.json, and later trade profile --against usual.json
    """
    if learn_file is not None and against is not None:
        raise UsageError(where="trade profile", problem="takes only one of --learn and --against")
    usual = None if against is None else read(against)
    out = Output(as_json=as_json)
    with visitor_among_others(context) as member:
        spans = member.spans(container=container)
    if usual is not None:
        _compare(out, deviations(spans, usual))
        return
    if learn_file is not None:
        model = learn(spans)
        write(learn_file, model)
        out.say(f"learned what follows {len(model.after)} services from {len(spans)} spans: {escape(str(learn_file))}")
        if as_json:
            out.data(model)
        return
    _show(out, statistics(spans))


def _compare(out: Output, found: Sequence[Deviation]) -> None:
    if out.as_json:
        out.data(found)
    elif not found:
        out.say("no call deviates from what was learned")
    else:
        rows = [
            (one.kind, one.before, one.after, f"{one.usual:.1%}", f"{one.now:.1%}", str(one.call_id)) for one in found
        ]
        out.table(("KIND", "AFTER", "COMES", "USUALLY", "NOW", "FOR EXAMPLE"), rows)
    if found:
        raise typer.Exit(1)


def _show(out: Output, found: Sequence[Statistics]) -> None:
    if out.as_json:
        out.data(found)
    elif not found:
        out.say("no call was traced; [bold]trade tracing on[/] traces calls from now on")
    else:
        rows = [
            (
                one.service,
                str(one.calls),
                str(one.errors),
                *(f"{s * 1e3:.2f} ms" for s in (one.p50_s, one.p99_s, one.max_s)),
                ", ".join(one.callers),
            )
            for one in found
        ]
        out.table(("SERVICE", "CALLS", "ERRORS", "P50", "P99", "MAX", "CALLERS"), rows)


def statistics(spans: Iterable[Span]) -> list[Statistics]:
    """Returns statistics by service, the most called first; spans of the serving side take precedence."""
    calls: dict[int, Span] = {}
    for span in spans:
        if span.call_id not in calls or span.side == "served":
            calls[span.call_id] = span
    by_service: dict[str, list[Span]] = {}
    for span in calls.values():
        by_service.setdefault(span.service, []).append(span)
    found = [_statistics(service, noted) for service, noted in by_service.items()]
    return sorted(found, key=lambda one: (-one.calls, one.service))


def _statistics(service: str, noted: Sequence[Span]) -> Statistics:
    took = sorted(span.took_s for span in noted)
    return Statistics(
        service=service,
        calls=len(noted),
        errors=sum(span.outcome != "ok" for span in noted),
        p50_s=_rank(took, 0.50),
        p99_s=_rank(took, 0.99),
        max_s=took[-1],
        callers=tuple(sorted({span.caller for span in noted})),
    )


def _rank(ordered: Sequence[float], part: float) -> float:
    """Returns a percentile by the nearest-rank method."""
    return ordered[math.ceil(part * len(ordered)) - 1]
