"""``trade tracing`` and ``trade trace``: have calls noted, and see the tree that one belongs to."""

from collections.abc import Iterator
from typing import Annotated, Final, Literal

import typer

from trade import Span, Trace
from trade._timestamps import clock
from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import visitor_among_others

_LATEST: Final = 20

Name = Annotated[str, typer.Option(help="Only of this container; * and ? stand for anything.")]
_Row = tuple[str, str, str, str, str, str]


def tracing(
    context: typer.Context,
    switch: Annotated[Literal["on", "off"], typer.Argument(help="Whether calls are to be noted.")],
    container: Name = "*",
    as_json: Json = False,
) -> None:
    """Have containers note the calls they make and serve, or no more. Those that start later: TRADE_TRACE=1.

    For example: trade tracing on
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as member:
        own = member.name
        names = [name for name in member.set_tracing(switch == "on", container=container) if name != own]
    if not names:
        raise UsageError(where=f"--container {container}", problem="there is no such container in this system")
    if as_json:
        out.data(names)
    for name in names:
        out.say(f"{'traced' if switch == 'on' else 'not traced any more'}: {name}")


def trace(
    context: typer.Context,
    call_id: Annotated[int | None, typer.Argument(help="A call; without one, the latest are listed.")] = None,
    as_json: Json = False,
) -> None:
    """Show the tree of calls that a call belongs to: when, how long, where, for whom, what was noted and logged.

    Times are by the clocks of the hosts: between hosts they are as good as these agree. First: trade tracing on

    For example: trade trace 2873421361915625477
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as member:
        if call_id is None:
            _list(out, member.spans())
            return
        found = member.trace(call_id)
    if as_json:
        out.data(found)
        return
    columns = ("CALL", "AT", "TOOK", "OUTCOME", "CONTAINER", "ID")
    out.table(columns, list(_rows(found, found.began, 0)))


def _list(out: Output, spans: list[Span]) -> None:
    """The latest that nothing known led to."""
    latest = list({span.call_id: span for span in spans if not span.calls}.values())[-_LATEST:]
    if out.as_json:
        out.data(latest)
    elif not latest:
        out.say("no call has been noted; [bold]trade tracing on[/] has calls noted from now on")
    else:
        rows = [
            (str(span.call_id), span.service, clock(span.began, ms=True), _ms(span.took_s), span.outcome, span.caller)
            for span in latest
        ]
        out.table(("ID", "SERVICE", "BEGAN", "TOOK", "OUTCOME", "CALLER"), rows)


def _rows(node: Trace, start: float, depth: int) -> Iterator[_Row]:
    """A line for a call and each thing that happened in it, in the order of time; those of calls within it indented."""
    first = node.spans[0] if node.spans else None
    took = "" if first is None else _ms(first.took_s)
    where = " > ".join(dict.fromkeys(span.container for span in node.spans))
    outcome = "" if first is None else first.outcome
    indent = "  " * depth
    yield f"{indent}{node.service}", _ms(node.began - start), took, outcome, where, str(node.call_id)
    inner: list[tuple[float, list[_Row]]] = [(call.began, list(_rows(call, start, depth + 1))) for call in node.calls]

    def told(at: float, text: str) -> None:
        inner.append((at, [(f"{indent}  - {text}", _ms(at - start), "", "", "", "")]))

    if (served := node.served) is not None:
        if served.waited_s:
            told(served.began, f"had waited {_ms(served.waited_s)} for its turn")
        for lock in served.locks:
            told(served.began, f"under the lock: {lock}")
        for after_s, text in served.events:
            told(served.began + after_s, text)
    for line in node.lines:
        told(line.at, f"{line.level_name}: {line.text.splitlines()[0]}")
    for _, rows in sorted(inner, key=lambda one: one[0]):
        yield from rows


def _ms(s: float) -> str:
    return f"{s * 1e3:.1f} ms"
