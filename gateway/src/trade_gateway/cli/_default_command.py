"""A group of commands of which one is meant where none is named."""

from typing import Any

from typer.core import TyperGroup

__all__ = ["FirstByDefault"]


class FirstByDefault(TyperGroup):
    """``trade audit FOLDER`` is ``trade audit show FOLDER``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """What begins with none of the commands is for the first."""
        if not args or args[0] not in (*self.commands, "-h", "--help"):
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)
