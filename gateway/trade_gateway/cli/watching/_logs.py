"""``trade logs``: shows the logs of all processes of a system."""

import logging
import threading
from typing import Annotated, Final, Literal

import typer
from rich.markup import escape

from trade import LogLine, LogReader
from trade.timestamps import clock
from trade_gateway.cli.watching._trace import Name
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor_among_others

_EVERY_S: Final = 0.5
Level = Literal["debug", "info", "warning", "error", "critical"]


def logs(
    context: typer.Context,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Keep printing new lines until Ctrl-C.")] = False,
    level: Annotated[
        Literal["debug", "info", "warning", "error", "critical"], typer.Option(help="Lowest level to show.")
    ] = "debug",
    container: Name = "*",
    call: Annotated[
        int | None, typer.Option(help="Id of a call: show only its lines and those of calls it led to.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show what all processes log to the logger "trade", in order of time.

    Times are those of the hosts' clocks. Each process keeps its latest 2,000 lines that pass its own level.
    With --json, each line is an object.

    For example: trade logs -f --level warning
    """
    least: int = getattr(logging, level.upper())
    out, pause = Output(as_json=as_json), threading.Event()
    with visitor_among_others(context) as member:
        reader = LogReader(member, container)
        while True:
            for line in reader.read():
                meant = call in (None, line.call_id, line.outer_id)
                if meant and line.level >= least and line.container != member.name:
                    _say(out, line)
            if not follow:
                return
            pause.wait(_EVERY_S)


def _say(out: Output, line: LogLine) -> None:
    if out.as_json:
        out.data(line)
    call = f"  (call {line.call_id})" if line.call_id else ""
    out.say(escape(f"{clock(line.at, ms=True)} {line.level_name:8} {line.container}: {line.text}{call}"))
