"""``trade stubs GROUP``: writes typed Python classes for the services of a group."""

from pathlib import Path
from typing import Annotated, Final

import typer

from trade.atomic_files import replace
from trade_gateway._usage import asked_for
from trade_gateway.stubs import write_stubs
from trade_gateway.terminal import sections
from trade_gateway.terminal._completion import groups
from trade_gateway.terminal._options import Wait
from trade_gateway.terminal._system_choice import visitor_among_others

SECTION: Final = sections.SERVICES
PLACE: Final = 5
_MODE = 0o644


def stubs(
    context: typer.Context,
    group: Annotated[
        str, typer.Argument(autocompletion=groups, help="Group to write, with the groups beneath it: rosie.")
    ],
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write; by default standard output.")
    ] = None,
    wait: Wait = 2.0,
) -> None:
    """Write typed Python classes for the services of a group.

    They describe what runs now. Write them again when the robot changes.

    For example: trade stubs rosie --output rosie_types.py
    """
    asked_for(f"group {group!r}", group=group, name=None)
    with visitor_among_others(context) as container:
        container.robot(group, wait_s=wait)
        text = write_stubs(container.services(group), group, container.settings.system)
    if output is None:
        typer.echo(text, nl=False)
    else:
        replace(output, text.encode(), _MODE)
