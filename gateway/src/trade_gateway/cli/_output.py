"""How the command line speaks: tables for people, JSON lines for programs, errors on stderr."""

import json
import re
import shutil
import sys
from collections.abc import Sequence
from typing import Any, Final

import msgspec
from rich.console import Console
from rich.markup import escape

from trade.errors import DeviceFault

_GAP: Final = "  "
_SMALL: Final = re.compile(r'^( *(?:"(?:[^"\\]|\\.)*": )?)(-?[\d.]+e-\d+)(?=,?$)', re.MULTILINE)
"""A number with an exponent, on its line of indented JSON."""
_LEAST: Final = 20
"""No column is cut shorter than this; columns on the right are left out before."""


class Output:
    """Standard output in one of two languages."""

    def __init__(self, *, as_json: bool) -> None:
        self.as_json = as_json
        self._console = Console(highlight=False, soft_wrap=True)

    def data(self, value: Any) -> None:
        """A result: one line of JSON, or indented for people, who get no more digits than anybody reads."""
        text = msgspec.json.encode(value).decode()
        if not self.as_json:
            text = json.dumps(json.loads(text, parse_float=_readable), indent=2, ensure_ascii=False)
            text = _SMALL.sub(_without_exponent, text)
        print(text, flush=True)  # noqa: T201

    def say(self, text: str) -> None:
        """A line for people; programs do not get it."""
        if not self.as_json:
            self._console.print(text)
            sys.stdout.flush()

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Rows for people: in a terminal no wider than it, in a pipe whole."""
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        head, *lines = table_lines(columns, rows, width)
        self._console.print(f"[bold]{escape(head)}[/]")
        for line in lines:
            self._console.print(line, markup=False)
        sys.stdout.flush()


def _readable(number: str) -> float:
    """Rounded to six places, and never a zero below zero."""
    return round(float(number), 6) + 0.0


def _without_exponent(found: re.Match[str]) -> str:
    return f"{found[1]}{float(found[2]):.6f}".rstrip("0")


def table_lines(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int | None) -> list[str]:
    """The lines of a table, the header first.

    Args:
        columns: the headers, the most important one first.
        rows: as many texts in each.
        width: of the terminal, in characters: what does not fit is left out from the right, then the widest column is
            cut. None: nothing is left out or cut.
    """
    widths = [max(map(len, texts)) for texts in zip(columns, *rows, strict=True)]
    if width is not None:
        widths = _fitted(widths, width)
    lines = [_GAP.join(map(_cut, row, widths)).rstrip() for row in (columns, *rows)]
    if width is not None and (left_out := columns[len(widths) :]):
        lines.append(_cut(f"({', '.join(left_out)}: in a wider terminal, or with --json)", width).rstrip())
    return lines


def _fitted(widths: Sequence[int], width: int) -> list[int]:
    fitted = list(widths)
    while (excess := sum(fitted) + len(_GAP) * (len(fitted) - 1) - width) > 0:
        widest = fitted.index(max(fitted))
        if fitted[widest] - excess >= _LEAST:
            fitted[widest] -= excess
        elif len(fitted) > 1:
            fitted.pop()
        else:
            return [width]
    return fitted


def _cut(text: str, width: int) -> str:
    return text.ljust(width) if len(text) <= width else text[: width - 1] + "…"


def complain(text: str) -> None:
    """A line on standard error, for programs, too: what went wrong, and that one goes on."""
    Console(stderr=True, highlight=False, soft_wrap=True).print(f"[bold yellow]warning[/]: {escape(text)}")
    sys.stderr.flush()


REMEDIES: Final = {
    "Wait with trade.lock(..., wait_s=...) or ask with trade.request_release(...)": (
        "Wait with `trade lock --wait SECONDS`, or take it away with `trade unlock GROUP --break REASON`"
    ),
    "Take it again with trade.lock(...)": "Take it again with `trade lock`",
    "Look it up again with trade.find(...)": "`trade services` lists all services",
    "take them all with trade.services(...)": "see all of them with `trade services`",
    "handle.with_(deadline_s=...) waits longer": "--deadline SECONDS waits longer",
    "give it a longer one": "--deadline SECONDS gives it more",
    "with_(deadline_s=...) gives it more": "--deadline SECONDS gives it more",
    "trade.resume(...) or `trade resume": "`trade resume",
}
"""What errors tell a program to do, and what somebody at a terminal does instead."""
_CALLED: Final = re.compile(r"(?:\bcall )?\b([a-z_]+)\(\)")


def as_commands(device: str, remedy: str) -> str:
    """What a driver says to call, as it is typed: ``call enable()`` is ``trade call rosie.neck.pan.enable``."""
    return _CALLED.sub(lambda found: f"`trade call {device}.{found[1]}`", remedy)


def say_error(error: BaseException) -> None:
    """The error's name and message on standard error; what helps in words of the command line."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    message = str(error)
    for remedy, ours in REMEDIES.items():
        message = message.replace(remedy, ours)
    if isinstance(error, DeviceFault):
        message = as_commands(error.device, message)
    console.print(f"[bold red]{type(error).__name__}[/]: {escape(message)}")
    sys.stderr.flush()
