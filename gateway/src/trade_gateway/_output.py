"""How the command line speaks: tables for people, JSON lines for programs, errors on stderr."""

import sys
from collections.abc import Sequence
from typing import Any

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.table import Table


class Output:
    """Standard output in one of two languages."""

    def __init__(self, *, as_json: bool) -> None:
        self.as_json = as_json
        self._console = Console(highlight=False, soft_wrap=True)

    def data(self, value: Any) -> None:
        """A result: one line of JSON, or indented for people."""
        data = msgspec.json.encode(value)
        print(data.decode() if self.as_json else msgspec.json.format(data, indent=2).decode(), flush=True)  # noqa: T201

    def say(self, text: str) -> None:
        """A line for people; programs do not get it."""
        if not self.as_json:
            self._console.print(text)

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Rows for people, as wide as the terminal."""
        table = Table(box=None, header_style="bold", pad_edge=False)
        for column in columns:
            table.add_column(column, overflow="fold")
        for row in rows:
            table.add_row(*map(escape, row))
        Console(highlight=False).print(table)


def say_error(error: BaseException) -> None:
    """The error's name and message on standard error."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    console.print(f"[bold red]{type(error).__name__}[/]: {escape(str(error))}")
    sys.stderr.flush()
