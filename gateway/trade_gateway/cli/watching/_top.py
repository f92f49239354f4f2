"""``trade top``: shows load, locks and unhealthy providers of a system, refreshed periodically."""

import shutil
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Annotated, Final

import typer
from msgspec import Struct
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from trade import Container, Handle, LoadInfo, where
from trade.protocol.messages import HEALTHY
from trade.timestamps import clock
from trade_gateway.clients._load_table import loads_table
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, table_lines
from trade_gateway.terminal._system_choice import visitor

_ANSWERS_WITHIN_S: Final = 1.0


class UnhealthyProvider(Struct, frozen=True):
    """A provider that is not healthy."""

    group: str
    container: str
    health: str


class Locked(Struct, frozen=True):
    """A lock, with its owner and purpose."""

    resources: tuple[str, ...]
    owner: str
    purpose: str
    since: float
    waiting: tuple[str, ...]


class SystemSnapshot(Struct, frozen=True):
    """A snapshot of a system; with ``--json`` one line."""

    at: float
    system: str
    services: int
    containers: Sequence[LoadInfo]
    """The containers, the busiest first."""
    silent: Sequence[str]
    """Containers that did not answer within 1 s."""
    unwell: Sequence[UnhealthyProvider]
    locks: Sequence[Locked]
    estops: Sequence[str]
    """The open e-stops, each with its giver and reason."""


def top(
    context: typer.Context,
    every: Annotated[float, typer.Option(min=1.0, max=3600.0, metavar="SECONDS", help="Interval, in seconds.")] = 2.0,
    count: Annotated[int | None, typer.Option(min=1, help="Number of refreshes; by default until Ctrl-C.")] = None,
    as_json: Json = False,
) -> None:
    """Show load, locks and unhealthy providers, refreshed periodically.

    Rates are averages since the last refresh. With --json, each refresh is an object.

    For example: trade top --every 5
    """
    out, looks = Output(as_json=as_json), 0
    with visitor(context) as container, _screen(out) as show:
        _ask(container)  # rates count from here on
        while count is None or looks < count:
            threading.Event().wait(every)
            show(look(container))
            looks += 1


def look(container: Container) -> SystemSnapshot:
    """Takes a snapshot of the system, as this container sees it."""
    loads, silent = _ask(container)
    services = container.services(~where(group="trade") & ~where.local)
    return SystemSnapshot(
        at=time.time(),
        system=container.settings.system,
        services=len(services),
        containers=sorted(loads, key=lambda info: -info.cpu_percent),
        silent=silent,
        unwell=_unwell(services),
        locks=[
            Locked(info.resources, info.holder.owner, info.holder.purpose, info.holder.since, tuple(info.waiting))
            for info in container.locks()
        ],
        estops=[f"{known.giver}: {known.reason}" if known.reason else known.giver for known in container.estops()],
    )


def _ask(container: Container) -> tuple[list[LoadInfo], list[str]]:
    asked = container.services(where(name="load", group="trade") & ~where.local)
    outcomes = container.call_all([handle.with_(deadline_s=_ANSWERS_WITHIN_S).bind() for handle in asked])
    silent = [outcome.handle.container for outcome in outcomes if not outcome.ok]
    return [outcome.result for outcome in outcomes if outcome.ok], sorted(silent)


def _unwell(services: Sequence[Handle]) -> list[UnhealthyProvider]:
    found = {
        UnhealthyProvider(handle.groups[0] if handle.groups else handle.label, handle.container, handle.health)
        for handle in services
        if handle.health != HEALTHY
    }
    return sorted(found, key=lambda one: one.group)


@contextmanager
def _screen(out: Output) -> Generator[Callable[[SystemSnapshot], None]]:
    if out.as_json or not sys.stdout.isatty():
        yield out.data if out.as_json else lambda shown: out.say("\n".join(_lines(shown, None)) + "\n")
        return
    with Live(console=Console(highlight=False), screen=True, auto_refresh=False) as live:

        def show(shown: SystemSnapshot) -> None:
            width, height = shutil.get_terminal_size()
            lines = [Text(line, no_wrap=True) for line in _lines(shown, width)[: height - 1]]
            lines[0].stylize("bold red" if shown.estops else "bold")
            live.update(Group(*lines), refresh=True)

        yield show


def _lines(shown: SystemSnapshot, width: int | None) -> list[str]:
    """Returns the lines of the whole screen."""
    counts = [f"{len(shown.containers) + len(shown.silent)} containers", f"{shown.services} services"]
    counts += [f"{len(items)} {word}" for items, word in ((shown.unwell, "not well"), (shown.locks, "locked")) if items]
    lines = [
        f"{shown.system}  {clock(shown.at)}  {', '.join(counts)}",
        *(f"E-STOP OPEN, by {one}" for one in shown.estops),
        "",
    ]
    columns, rows = loads_table(shown.containers)
    rows += [(name, "no answer", *[""] * (len(columns) - 2)) for name in shown.silent]
    lines += table_lines(columns, rows, width)
    if shown.unwell:
        found = [(one.group, one.container, one.health) for one in shown.unwell]
        lines += ["", *table_lines(("NOT WELL", "CONTAINER", "WHY"), found, width)]
    if shown.locks:
        held = [
            (", ".join(one.resources), one.owner, one.purpose, f"{shown.at - one.since:.0f} s", ", ".join(one.waiting))
            for one in shown.locks
        ]
        lines += ["", *table_lines(("LOCKED", "OWNER", "PURPOSE", "FOR", "WAITING"), held, width)]
    return lines
