"""Parts that commands share: options, a default command, and packages of an extra."""

from importlib import import_module
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from trade.errors import ConfigurationError
from trade_gateway.terminal._completion import groups

SELECT: Final = "What to select"
CONNECTION: Final = "Connection"
SECURITY: Final = "Security"
TIMING: Final = "Timing"
OUTPUT: Final = "Output"

Json = Annotated[bool, typer.Option("--json", rich_help_panel=OUTPUT, help="Print JSON.")]
Wait = Annotated[
    float,
    typer.Option(
        min=0.0, rich_help_panel=TIMING, metavar="SECONDS", help="Time to wait for the service to appear, in seconds."
    ),
]
Groups = Annotated[
    list[str] | None,
    typer.Option("--group", autocompletion=groups, help="Select this group and the groups beneath it. Repeatable."),
]
Readers = Annotated[
    list[str] | None,
    typer.Option(
        "--services",
        help="Also sample this read-only service: rosie.hand.state; * and ? are wildcards. Repeatable.",
    ),
]


def room_of_extra(extra: str, command: str) -> Any:
    """Imports the subpackage whose libraries the extra of the same name installs. Raises ConfigurationError."""
    room = import_module(f"trade_gateway.{extra}")
    try:
        for name in room.__all__:
            getattr(room, name)
    except ImportError as missing:
        problem = f"needs {missing.name}; pip install 'trade-gateway[{extra}]'"
        raise ConfigurationError(where=command, problem=problem) from None
    return room


class FirstByDefault(TyperGroup):
    """A command group whose first command is the default: ``trade audit FOLDER`` is ``trade audit show FOLDER``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Inserts the first command if the words begin with none."""
        if not args or args[0] not in (*self.commands, "-h", "--help"):
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)
