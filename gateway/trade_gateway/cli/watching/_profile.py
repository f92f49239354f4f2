"""``trade profile``: shows counts and durations of calls, and deviations from a learned model."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from msgspec import Struct
from rich.markup import escape

from trade import CallDeviation, CallModel, Span
from trade.atomic_files import replace
from trade.call_model import deviations, learn
from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade_gateway._usage import UsageError
from trade_gateway.cli.watching._trace import Name
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._system_choice import visitor_among_others


def write(path: Path, model: CallModel) -> None:
    """Writes a model. Raises ConfigurationError."""
    try:
        replace(path.resolve(), msgspec.json.format(msgspec.json.encode(model), indent=2) + b"\n", 0o644)
    except OSError as problem:
        raise ConfigurationError(where=str(path), problem=str(problem)) from None


def read(path: Path) -> CallModel:
    """Reads a model. Raises ConfigurationError."""
    try:
        return msgspec.json.decode(read_text(path), type=CallModel)
    except (OSError, UnicodeDecodeError, msgspec.DecodeError) as problem:
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
    watch_file: Annotated[
        Path | None, typer.Option("--watch", help="File that containers compare their calls with from now on.")
    ] = None,
    container: Name = "*",
    as_json: Json = False,
) -> None:
    """Show how often services were called, and how long they took.

    Only traced calls count, so run `trade tracing on` first.
    --learn records, for each service, what the same caller called next.
    --watch gives this to the containers, which compare the calls that they make from then on.
    trade containers --show events lists what deviates.

    For example: trade profile --learn usual.json, and later trade profile --against usual.json
    """
    if sum(file is not None for file in (learn_file, against, watch_file)) > 1:
        raise UsageError(where="trade profile", problem="takes only one of --learn, --against and --watch")
    usual = None if against is None else read(against)
    out = Output(as_json=as_json)
    if watch_file is not None:
        _watch(context, out, container, read(watch_file))
        return
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


def _watch(context: typer.Context, out: Output, container: str, usual: CallModel) -> None:
    """Gives containers a model to compare their calls with."""
    with visitor_among_others(context) as member:
        present = member.everywhere("watch_calls", container=container)
        asked = member.call_all([handle for handle in present.handles if not handle.local], usual)
    for address in present.silent:
        complain(f"{address.container} did not answer: it has not listed its services")
    for outcome in asked:
        if not outcome.ok:
            complain(f"{outcome.handle.container} did not answer: {outcome.error}")
    watched = sorted(outcome.handle.container for outcome in asked if outcome.ok)
    if out.as_json:
        out.data({"watched": watched})
    else:
        out.say(f"these compare the calls that they make: {escape(', '.join(watched)) or 'none'}")
    if present.silent or len(watched) < len(asked):
        raise typer.Exit(1)


def _compare(out: Output, found: Sequence[CallDeviation]) -> None:
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
