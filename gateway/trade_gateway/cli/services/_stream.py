"""``trade stream GROUP.NAME``: prints the samples of a stream."""

import itertools
from typing import Annotated

import msgspec
import typer

from trade import Sample
from trade.timestamps import clock
from trade_gateway._usage import find
from trade_gateway.terminal._completion import services
from trade_gateway.terminal._options import OUTPUT, SELECT, TIMING, Json, Wait
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor


def stream(
    context: typer.Context,
    service: Annotated[
        str, typer.Argument(autocompletion=services, help="Group and name of a read-only service: rosie.head.state.")
    ],
    hz: Annotated[
        float,
        typer.Option(min=0.001, max=1000.0, rich_help_panel=TIMING, metavar="HZ", help="Highest sample rate, in Hz."),
    ] = 10.0,
    on_change: Annotated[
        bool, typer.Option("--on-change", rich_help_panel=OUTPUT, help="Print a sample only if it changed.")
    ] = False,
    count: Annotated[
        int | None,
        typer.Option(min=1, rich_help_panel=OUTPUT, help="End after this many samples; by default at Ctrl-C."),
    ] = None,
    wait: Wait = 2.0,
    container: Annotated[
        str | None, typer.Option(rich_help_panel=SELECT, help="Stream the service of this container.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Print the samples of a service as they arrive.

    For example: trade stream rosie.head.state --hz 20 --json
    """
    out = Output(as_json=as_json)
    with (
        visitor(context) as visiting,
        visiting.stream(find(visiting, service, container, wait), hz=hz, on_change=on_change) as samples,
    ):
        for sample in itertools.islice(samples, count):
            if as_json:
                out.data(sample)
            else:
                print(_line(sample), flush=True)  # noqa: T201 - values are no markup


def _line(sample: Sample) -> str:
    missing = f"  ({sample.dropped} missing before it)" if sample.dropped else ""
    return f"{clock(sample.at, ms=True)}  {msgspec.json.encode(sample.value).decode()}{missing}"
