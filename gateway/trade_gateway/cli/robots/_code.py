"""``trade code PATH``: shows the hash of code, and brings it to a container."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from trade.starting import hash_of, pack
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor


def code(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(metavar="PATH", help="A wheel, a zip file, or a folder of modules.")],
    to: Annotated[
        str | None, typer.Option(metavar="CONTAINER", help="Bring it to this container, which must list its hash.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show the hash of code, or bring it to a container that lists the hash.

    The container takes it if it was started with trade container --code SHA256.

    For example: trade code ./mypkg --to eyes
    """
    out = Output(as_json=as_json)
    if to is None:
        sha256 = hash_of(pack(path))
        out.say(sha256)
    else:
        with visitor(context) as container:
            sha256 = container.system.send_code(to, path)
        out.say(f"[bold green]{escape(to)} has taken[/] {escape(str(path))}, SHA-256 {sha256}")
    if as_json:
        out.data({"sha256": sha256, "container": to})
