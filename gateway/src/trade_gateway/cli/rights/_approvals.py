"""``trade approvals``: what agents may not do without a person's word, and that word."""

import time
from collections.abc import Iterator
from typing import Annotated, Any, Final

import typer
from rich.markup import escape

from trade import Container, Handle, where
from trade.errors import ConfigurationError, TradeError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output, complain
from trade_gateway.cli._system_choice import visitor_among_others
from trade_gateway.clients._schemas import APPROVALS

_COLUMNS: Final = ("id", "agent", "service", "arguments", "why", "waits")

app = typer.Typer(
    invoke_without_command=True,
    help="What agents ask for and wait to be allowed; who administers it decides.\n\n"
    "For example: trade approvals, and then trade approvals yes 1f3a9c",
)
Id = Annotated[str, typer.Argument(help="As trade approvals shows it.")]


@app.callback()
def approvals(context: typer.Context, as_json: Json = False) -> None:
    """Show what waits."""
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
    """Let that call be made, once.

    For example: trade approvals yes 1f3a9c
    """
    _decide(context, id, "approve", id)
    Output(as_json=False).say(f"{escape(id)} is approved")


@app.command()
def no(
    context: typer.Context,
    id: Id,  # noqa: A002
    reason: Annotated[str, typer.Option(help="The agent is told.")] = "",
) -> None:
    """Have that call not be made.

    For example: trade approvals no 1f3a9c --reason "somebody stands there"
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
    raise ConfigurationError(where=f"approval {name!r}", problem="nothing of that id waits; see trade approvals")


def _pending(container: Container) -> Iterator[tuple[Handle, dict[str, Any]]]:
    for handle in container.services(where(name="pending", group=APPROVALS)):
        try:
            for one in handle():
                yield handle, {name: getattr(one, name) for name in ("id", "agent", "service", "args", "why", "until")}
        except TradeError as error:
            complain(f"{handle.container} does not say what it waits for: {error}")


def _row(one: dict[str, Any], now: float) -> tuple[str, ...]:
    left = f"{max(0.0, one['until'] - now):.0f} s more"
    return (one["id"], one["agent"], one["service"], one["args"], one["why"], left)
