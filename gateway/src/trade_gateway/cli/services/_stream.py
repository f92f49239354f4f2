"""``trade stream GROUP.NAME``: print what a service answers, again and again."""

import itertools
from typing import Annotated

import msgspec
import typer

from trade import Sample
from trade._timestamps import clock
from trade_gateway._usage import find
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import visitor


def stream(
    context: typer.Context,
    service: Annotated[str, typer.Argument(help="Group and name of what only reads: rosie.head.state.")],
    hz: Annotated[float, typer.Option(min=0.001, max=1000.0, help="Samples a second, at most.")] = 10.0,
    on_change: Annotated[bool, typer.Option("--on-change", help="Only samples unlike the one before.")] = False,
    count: Annotated[int | None, typer.Option(min=1, help="End after so many; else with Ctrl-C.")] = None,
    wait: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for the service to appear.")] = 2.0,
    container: Annotated[str | None, typer.Option(help="Only the service of this container.")] = None,
    as_json: Json = False,
) -> None:
    """Print samples of a service as they come; with --json one object a line.

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
