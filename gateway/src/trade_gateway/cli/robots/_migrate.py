"""``trade migrate GROUP --to CONTAINER``: a provider goes on in another container."""

from typing import Annotated

import typer
from rich.markup import escape

from trade_gateway._usage import asked_for
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import visitor_among_others
from trade_gateway.cli.services._services import describe


def migrate(
    context: typer.Context,
    group: Annotated[str, typer.Argument(help="The provider's group, or one above it that has no other provider.")],
    to: Annotated[str, typer.Option(help="Name of the container; with * or ?, the least busy one that fits.")],
    name: Annotated[
        str | None, typer.Option(help="Of one of its services, if the group has several providers.")
    ] = None,
    container: Annotated[str | None, typer.Option(help="The container it is in, if there are several.")] = None,
    as_json: Json = False,
) -> None:
    """Have a provider go on in another container, on this host or another one, with its state.

    It is refused while it is locked or moves; what fails leaves it where it is. Its class must be allowed there.

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
