"""``trade start HOST NAME``: starts an empty container on another host."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from trade_gateway.terminal._options import CONNECTION, SECURITY, TIMING, Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor


def start(
    context: typer.Context,
    host: Annotated[str, typer.Argument(metavar="HOST", help="HOST or USER@HOST, as for ssh.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the container.")],
    allow: Annotated[
        list[str] | None, typer.Option(rich_help_panel=SECURITY, help="Classes it may create. Repeatable.")
    ] = None,
    dial: Annotated[
        list[str] | None, typer.Option(rich_help_panel=CONNECTION, help="Endpoint to connect to from HOST. Repeatable.")
    ] = None,
    command: Annotated[str, typer.Option(rich_help_panel=CONNECTION, help="Path of trade on HOST.")] = "trade",
    ssh_config: Annotated[
        Path | None, typer.Option(rich_help_panel=CONNECTION, help="Configuration of ssh instead of ~/.ssh/config.")
    ] = None,
    wait: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=600.0,
            rich_help_panel=TIMING,
            metavar="SECONDS",
            help="Time until it must be visible, in seconds.",
        ),
    ] = 10.0,
    as_json: Json = False,
) -> None:
    """Start an empty container on another host through ssh.

    The container outlives this command. Set up ssh before: the host's key must be known, and ssh may not prompt.

    For example: trade start robot.example eyes --allow "mypkg.vision:*"
    """
    out = Output(as_json=as_json)
    with visitor(context) as container:
        started = container.system.start_container(
            host,
            name,
            allow=allow or (),
            connect=dial or (),
            command=(command,),
            ssh_config=ssh_config,
            wait_s=wait,
        )
    if as_json:
        out.data(started)
    out.say(f"[bold green]{escape(started.name)} is up[/] on {escape(started.host)}, process {started.pid}")
    out.say(f"to end it: [bold]trade call trade.terminate_container '\"done\"' --container {escape(started.name)}[/]")
