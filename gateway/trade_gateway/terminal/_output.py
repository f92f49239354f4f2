"""Output of the command line: tables for people, JSON lines for programs, errors on stderr."""

import json
import re
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any, Final

import msgspec
from rich.console import Console
from rich.markup import escape

from trade import Settings
from trade.default_system import is_of_user
from trade.errors import RemoteError, TradeError, at_terminal
from trade.protocol.remote_errors import RemoteTraceback
from trade.stop_line import elsewhere

NOT_FOUND: Final = 3
"""The exit code if what a command was asked for does not exist."""
_GAP: Final = "  "
_SMALL: Final = re.compile(r'^( *(?:"(?:[^"\\]|\\.)*": )?)(-?[\d.]+e-\d+)(?=,?$)', re.MULTILINE)
"""A number with a negative exponent, on its line of indented JSON."""
_LEAST: Final = 20
"""The least width of a cut column, in characters; columns on the right are left out first."""


class Output:
    """Standard output, either as text for people or as JSON."""

    def __init__(self, *, as_json: bool) -> None:
        self.as_json = as_json
        self._console = Console(highlight=False, soft_wrap=True)

    def data(self, value: Any) -> None:
        """Prints a result: one line of JSON, or indented for people with rounded numbers."""
        text = msgspec.json.encode(value).decode()
        if not self.as_json:
            text = json.dumps(json.loads(text, parse_float=_readable), indent=2, ensure_ascii=False)
            text = _SMALL.sub(_without_exponent, text)
        print(text, flush=True)  # noqa: T201

    def say(self, text: str) -> None:
        """Prints a line of text; nothing with JSON."""
        if not self.as_json:
            self._console.print(text)
            sys.stdout.flush()

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Prints a table: cut to the terminal's width, or complete in a pipe."""
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        head, *lines = table_lines(columns, rows, width)
        self._console.print(f"[bold]{escape(head)}[/]")
        for line in lines:
            self._console.print(line, markup=False)
        sys.stdout.flush()


def _readable(number: str) -> float:
    """Rounds to six places, without a negative zero."""
    return round(float(number), 6) + 0.0


def _without_exponent(found: re.Match[str]) -> str:
    return f"{found[1]}{float(found[2]):.6f}".rstrip("0")


def table_lines(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int | None) -> list[str]:
    """Returns the lines of a table, the header first.

    Args:
        columns: the headers, the most important first.
        rows: one text per column.
        width: the terminal's width in characters. Columns that do not fit are left out from the right, then the
            widest column is cut. None: show everything.
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
    """Prints a warning on standard error; the command continues."""
    Console(stderr=True, highlight=False, soft_wrap=True).print(f"[bold yellow]warning[/]: {escape(text)}")
    sys.stderr.flush()


_FRAMES: Final = re.compile(r'^  File "(.+)", line (\d+), in (.+)\n((?:    .*\n)?)', re.MULTILINE)
"""The entries of a Python traceback: file, line, function and code."""


def say_unreached(endpoints: Iterable[str]) -> None:
    """Prints on standard error which endpoints did not answer a stop that all others have confirmed."""
    for endpoint in endpoints:
        complain(f"{endpoint} (TRADE_CONNECT) does not answer; a robot that is reached only there heard nothing")


def say_elsewhere(settings: Settings, *, earlier: bool = False) -> None:
    """Prints on standard error which robots of this user on this host are in other systems than the command.

    Args:
        settings: of the command.
        earlier: only those that run under an earlier name of the default system, where stops reach them, too.
    """
    for system, containers in elsewhere(settings).items():
        if not earlier or (is_of_user(system) and not settings.explicit_system):
            complain(f"system {system} has {', '.join(containers)}; commands reach it with: trade --system {system}")


def is_providers(error: BaseException) -> bool:
    """Whether the provider of a service raised it, and not this program."""
    return isinstance(error.__cause__, RemoteTraceback)


def say_error(error: BaseException, *, as_json: bool = False, whole: bool = False, rest: str = "") -> None:
    """Prints an error's name and message on standard error, with remedies as commands; or all its data as JSON.

    An error that is not TRADE's own is followed by the place where the provider raised it.

    Args:
        error: the error.
        as_json: as JSON.
        whole: with the provider's whole traceback before it.
        rest: how to see the whole traceback.
    """
    cause = error.__cause__
    traceback = cause.info.traceback if isinstance(cause, RemoteTraceback) else ""
    if as_json and isinstance(error, Exception):
        own = isinstance(error, TradeError)
        data = {field.name: getattr(error, field.name) for field in fields(error)} if own else {"traceback": traceback}
        shown = {"error": type(error).__name__, "message": at_terminal(error), "data": data}
        print(msgspec.json.encode(shown, enc_hook=str).decode(), file=sys.stderr, flush=True)  # noqa: T201
        return
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    if whole and traceback:
        console.print(traceback.rstrip(), markup=False)
    if not whole or not traceback or isinstance(error, TradeError):
        console.print(f"[bold red]{type(error).__name__}[/]: {escape(at_terminal(error))}")
    if not whole and (isinstance(error, RemoteError) or not isinstance(error, TradeError)):
        for line in _place(traceback, rest):
            console.print(line, markup=False)
    sys.stderr.flush()


def _place(traceback: str, rest: str) -> list[str]:
    """Where the provider raised it: the last place and line of its traceback, and how to see the others."""
    if not (found := _FRAMES.findall(traceback)):
        return []
    file, number, function, code = found[-1]
    place = f"  raised by the provider in {file}, line {number}, in {function}:"
    return [place, *([f"      {code.strip()}"] if code else []), *([f"  {rest}"] if rest else [])]
