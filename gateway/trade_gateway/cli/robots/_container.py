"""``trade container``: runs an empty container, in which other programs create providers."""

from dataclasses import replace
from typing import Annotated

import typer
from rich.markup import escape

from trade import Container
from trade_gateway.process._signals import leaving, refuse_twice, settle
from trade_gateway.terminal._detached import Detach, detach_now, ready
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import choice_of

_LOOK_EVERY_S = 0.2


def container(
    context: typer.Context,
    name: Annotated[str | None, typer.Option(help="Name of the container. \\[env: TRADE_CONTAINER]")] = None,
    allow: Annotated[
        list[str] | None,
        typer.Option(
            help="Classes it may create: mypkg.vision:Camera, mypkg.*. Repeatable. \\[env: TRADE_INSTANTIABLE]"
        ),
    ] = None,
    code: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SHA256", help="Code that it takes, by hash: see trade code. Repeatable. \\[env: TRADE_CODE]"
        ),
    ] = None,
    detach: Detach = False,
    as_json: Json = False,
) -> None:
    """Run an empty container until Ctrl-C, SIGTERM or terminate_container.

    For example: trade container --name eyes --allow "mypkg.vision:*"
    """
    out, settings = Output(as_json=as_json), choice_of(context).settings(name)
    if detach:
        detach_now(out, settings)
        return
    if allow:
        settings = replace(settings, instantiable=tuple(allow))
    if code:
        settings = replace(settings, code=tuple(code))
    with leaving() as asked_to_leave, Container(settings, on_terminate=asked_to_leave.set) as running:
        refuse_twice(running, "trade container")
        settle()
        if as_json:
            out.data({**ready(running), "instantiable": settings.instantiable})
        out.say(
            f"[bold green]{running.name} is up[/]; it may make {escape(', '.join(settings.instantiable)) or 'nothing'}"
        )
        out.say("Ctrl-C leaves")
        while not asked_to_leave.wait(_LOOK_EVERY_S):
            pass
        out.say("leaving")
