"""``trade profile``: which services are called how often and how long they take; what is not as usual."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer
from msgspec import Struct
from rich.markup import escape

from trade import Span
from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import visitor_among_others
from trade_gateway.cli.watching._call_model import Deviation, deviations, learn, read, write
from trade_gateway.cli.watching._trace import Name


class Statistics(Struct, frozen=True, kw_only=True):
    """The calls of one service."""

    service: str
    calls: int
    errors: int
    p50_s: float
    p99_s: float
    max_s: float
    callers: tuple[str, ...]


def profile(
    context: typer.Context,
    learn_file: Annotated[Path | None, typer.Option("--learn", help="Write down which call comes after which.")] = None,
    against: Annotated[Path | None, typer.Option(help="Compare with that; exit code 1: it deviates.")] = None,
    container: Name = "*",
    as_json: Json = False,
) -> None:
    """Show how often services were called and how long they took, from what was noted since they are traced.

    What is learned is, for each service, what the same caller called next. First: trade tracing on

    For example: trade profile --learn usual.json, and later trade profile --against usual.json
    """
    if learn_file is not None and against is not None:
        raise UsageError(where="trade profile", problem="either --learn or --against")
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
        out.say(
            f"learned what comes after {len(model.after)} services from {len(spans)} notes: {escape(str(learn_file))}"
        )
        if as_json:
            out.data(model)
        return
    _show(out, statistics(spans))


def _compare(out: Output, found: Sequence[Deviation]) -> None:
    if out.as_json:
        out.data(found)
    elif not found:
        out.say("nothing deviates from what was learned")
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
        out.say("no call has been noted; [bold]trade tracing on[/] has calls noted from now on")
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
    """By service, those called most first; of a call that both sides noted, what the serving one did."""
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
    """The least of them that this part of them does not exceed."""
    return ordered[math.ceil(part * len(ordered)) - 1]
