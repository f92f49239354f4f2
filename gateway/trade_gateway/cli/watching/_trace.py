"""``trade tracing`` and ``trade trace``: switch tracing of calls, and show the tree of a call."""

from collections.abc import Iterator
from typing import Annotated, Final, Literal

import typer

from trade import Span, Trace
from trade.timestamps import clock
from trade_gateway._usage import UsageError
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor_among_others

_LATEST: Final = 20

Name = Annotated[str, typer.Option(help="Only this container; * and ? are wildcards.")]
_Row = tuple[str, str, str, str, str, str]


def tracing(
    context: typer.Context,
    switch: Annotated[Literal["on", "off"], typer.Argument(help="Whether to trace calls.")],
    container: Name = "*",
    as_json: Json = False,
) -> None:
    """Switch tracing of calls on or off in running containers.

    For containers that start later, set TRADE_TRACE=1.

    For example: trade tracing on
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as member:
        own = member.name
        names = [name for name in member.set_tracing(switch == "on", container=container) if name != own]
    if not names:
        raise UsageError(where=f"--container {container}", problem="no such container is in this system")
    if as_json:
        out.data(names)
    for name in names:
        out.say(f"{'traced' if switch == 'on' else 'no longer traced'}: {name}")


def trace(
    context: typer.Context,
    call_id: Annotated[int | None, typer.Argument(help="Id of a call; by default the latest calls are listed.")] = None,
    as_json: Json = False,
) -> None:
    """Show the tree of a traced call with times, events and logs.

    Times are those of the hosts' clocks, and only as accurate as these agree. Run `trade tracing on` first.

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
    """Lists the latest top-level calls."""
    latest = list({span.call_id: span for span in spans if not span.calls}.values())[-_LATEST:]
    if out.as_json:
        out.data(latest)
    elif not latest:
        out.say("no call was traced; [bold]trade tracing on[/] traces calls from now on")
    else:
        rows = [
            (str(span.call_id), span.service, clock(span.began, ms=True), _ms(span.took_s), span.outcome, span.caller)
            for span in latest
        ]
        out.table(("ID", "SERVICE", "BEGAN", "TOOK", "OUTCOME", "CALLER"), rows)


def _rows(node: Trace, start: float, depth: int) -> Iterator[_Row]:
    """Returns the lines of a call and its events in order of time; inner calls are indented."""
    first = node.spans[0] if node.spans else None
    took = "" if first is None else _ms(first.took_s)
    where = " > ".join(dict.fromkeys(span.container for span in node.spans))
    outcome = "" if first is None else first.outcome
    indent = "  " * depth
    yield f"{indent}{node.service}", _ms(node.began - start), took, outcome, where, str(node.call_id)
    inner: list[tuple[float, list[_Row]]] = [(call.began, list(_rows(call, start, depth + 1))) for call in node.calls]

    def add(at: float, text: str) -> None:
        inner.append((at, [(f"{indent}  - {text}", _ms(at - start), "", "", "", "")]))

    if (served := node.served) is not None:
        if served.waited_s:
            add(served.began, f"had waited {_ms(served.waited_s)} for its turn")
        for lock in served.locks:
            add(served.began, f"under the lock: {lock}")
        for after_s, text in served.events:
            add(served.began + after_s, text)
    for line in node.lines:
        add(line.at, f"{line.level_name}: {line.text.splitlines()[0]}")
    for _, rows in sorted(inner, key=lambda one: one[0]):
        yield from rows


def _ms(s: float) -> str:
    return f"{s * 1e3:.1f} ms"
