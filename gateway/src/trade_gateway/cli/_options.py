"""Options that many commands have, and groups with a default command."""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup


class FirstByDefault(TyperGroup):
    """``trade audit FOLDER`` is ``trade audit show FOLDER``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """What begins with none of the commands is for the first."""
        if not args or args[0] not in (*self.commands, "-h", "--help"):
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)


Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
