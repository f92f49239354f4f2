"""``trade migrate GROUP --to CONTAINER``: moves a provider with its state to another container."""

from typing import Annotated

import typer
from rich.markup import escape

from trade_gateway._usage import asked_for
from trade_gateway.cli.services._services import describe
from trade_gateway.terminal._completion import containers, groups
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor_among_others


def migrate(
    context: typer.Context,
    group: Annotated[
        str, typer.Argument(autocompletion=groups, help="Group of the provider, or a group with only this provider.")
    ],
    to: Annotated[str, typer.Option(help="Target container; with * or ?, the least busy match.")],
    name: Annotated[str | None, typer.Option(help="Name of a service, if the group has several providers.")] = None,
    container: Annotated[
        str | None, typer.Option(autocompletion=containers, help="Current container, if several have the group.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Move a provider with its state to another container, on any host.

    It is refused while the provider is locked or moves. If it fails, the provider stays where it is.
    The target container must allow the provider's class.

    For example: trade migrate rosie.planner --to spare
    """
    out = Output(as_json=as_json)
    wanted = asked_for(f"group {group!r}", group=group, name=name, container=container)
    with visitor_among_others(context) as member:
        moved = member.migrate(wanted, to=to)
        if as_json:
            out.data([describe(handle) for handle in moved])
        for handle in moved:
            out.say(f"{escape(handle.label)} is in [bold]{escape(handle.container)}[/] now")
