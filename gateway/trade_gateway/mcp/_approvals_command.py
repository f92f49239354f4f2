"""``trade approvals``: shows the calls of agents that wait for human approval, and decides them."""

import time
from collections.abc import Iterator
from typing import Annotated, Any, Final

import typer
from rich.markup import escape

from trade import Container, Handle, where
from trade.errors import ConfigurationError, TradeError
from trade_gateway.clients._schemas import APPROVALS
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._system_choice import visitor_among_others

SECTION: Final = sections.RIGHTS
PLACE: Final = 2
_COLUMNS: Final = ("id", "agent", "service", "arguments", "why", "waits")

app = typer.Typer(
    invoke_without_command=True,
    help="Show the calls of agents that wait for approval; approve or refuse them.\n\n"
    "For example: trade approvals, and then trade approvals yes 1f3a9c",
)
Id = Annotated[str, typer.Argument(help="Id of the call, from trade approvals.")]


@app.callback()
def approvals(context: typer.Context, as_json: Json = False) -> None:
    """Show the calls that wait for approval."""
    if context.invoked_subcommand is not None:
        return
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        found = [one for _, one in _pending(container)]
    if as_json:
        out.data(found)
    elif not found:
        out.say("nothing waits for approval")
    else:
        now = time.time()
        out.table(_COLUMNS, [_row(one, now) for one in found])


@app.command()
def yes(context: typer.Context, id: Id) -> None:  # noqa: A002
    """Approve a call, once.

    For example: trade approvals yes 1f3a9c
    """
    _decide(context, id, "approve", id)
    Output(as_json=False).say(f"{escape(id)} is approved")


@app.command()
def no(
    context: typer.Context,
    id: Id,  # noqa: A002
    reason: Annotated[str, typer.Option(help="Reason, reported to the agent.")] = "",
) -> None:
    """Refuse a call.

    For example: trade approvals no 1f3a9c --reason "a person is in the way"
    """
    _decide(context, id, "refuse", id, reason)
    Output(as_json=False).say(f"{escape(id)} is refused")


def _decide(context: typer.Context, name: str, word: str, *args: str) -> None:
    with visitor_among_others(context) as container:
        for handle, one in _pending(container):
            if one["id"] == name:
                beside = where(name=word, container=handle.container)
                container.find(beside & where(group=handle.key.domain), wait_s=0)(*args)
                return
    raise ConfigurationError(where=f"approval {name!r}", problem="no call with this id waits; see `trade approvals`")


def _pending(container: Container) -> Iterator[tuple[Handle, dict[str, Any]]]:
    for handle in container.services(where(name="pending", group=APPROVALS)):
        try:
            for one in handle():
                yield handle, {name: getattr(one, name) for name in ("id", "agent", "service", "args", "why", "until")}
        except TradeError as error:
            complain(f"{handle.container} did not report its waiting calls: {error}")


def _row(one: dict[str, Any], now: float) -> tuple[str, ...]:
    left = f"{max(0.0, one['until'] - now):.0f} s more"
    return (one["id"], one["agent"], one["service"], one["args"], one["why"], left)
