"""The command ``trade``: starts robots, shows a system, calls its services."""

import os
import sys
from collections.abc import Sequence
from typing import Annotated, Final

import typer

from trade import errors
from trade.errors import TradeError
from trade_gateway._usage import ABSENT, UsageError
from trade_gateway.cli._commands import add_all
from trade_gateway.process._parent_watch import end_with_stdin
from trade_gateway.terminal._output import NOT_FOUND, is_providers, say_error
from trade_gateway.terminal._system_choice import SystemChoice

_COMPLETED: Final = ("COMP_WORDS", "_TYPER_COMPLETE_ARGS")
"""Environment variables in which a shell passes the line to complete."""
_FAILED: Final = 1
_USAGE: Final = 2
_MISSING: Final = (
    errors.NoSuchService,
    errors.NoSuchEstop,
    errors.NoSuchNotification,
    errors.NoSuchHook,
    errors.NoSuchCall,
    errors.NoSuchClass,
)
"""What a command was asked for does not exist."""
_CODES: Final = {UsageError: _USAGE, _MISSING: NOT_FOUND, errors.DeviceAbsent: ABSENT}
"""The exit codes of kinds of errors; of others it is `_FAILED`."""
_WITH_VALUE: Final = ("--system", "--connect")
"""Options before the command that take a value."""


def build(only: str | None = None) -> typer.Typer:
    """Builds the command line.

    Args:
        only: the only command that will run, so that the others are not imported. All, if there is none of that name.
    """
    made = typer.Typer(
        name="trade",
        no_args_is_help=True,
        rich_markup_mode="rich",
        help="Start robots, show their services and call them.\n\nFor example: trade up examples/rosie.toml --sim",
        epilog="Without hardware: run trade up examples/rosie.toml --sim, and trade services in another terminal.",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.callback()(options)
    add_all(made, only)
    return made


def _asked_for(words: Sequence[str]) -> str | None:
    """Returns the command among the words of a command line; None if there is none, so that help shows all."""
    left = iter(words)
    for word in left:
        if word in _WITH_VALUE:
            next(left, None)
        elif not word.startswith("-"):
            return word
    return None


def _words() -> Sequence[str]:
    """Returns the words of the command line, or of the line that a shell completes."""
    if "_TRADE_COMPLETE" in os.environ:
        line = next((os.environ[name] for name in _COMPLETED if name in os.environ), "")
        return line.split()[1:]
    return sys.argv[1:]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415 - only for this option

        typer.echo(f"trade {version('trade-gateway')}")
        raise typer.Exit


def options(
    context: typer.Context,
    system: Annotated[
        str | None, typer.Option(help="System id. Containers of other systems are invisible. \\[env: TRADE_SYSTEM]")
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint to connect to: tcp/127.0.0.1:7450. Repeatable. \\[env: TRADE_CONNECT]"),
    ] = None,
    with_stdin: Annotated[
        bool, typer.Option("--with-stdin", hidden=True, help="Exit when standard input closes.")
    ] = False,
    leased: Annotated[
        bool,
        typer.Option("--leased", hidden=True, help="With --with-stdin: exit when its lease expires."),
    ] = False,
    version: Annotated[  # noqa: ARG001 - answered by its callback
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Reads the options before the command."""
    if with_stdin:
        end_with_stdin(leased=leased)
    context.obj = SystemChoice(system, connect)


def _say(error: Exception, words: Sequence[str]) -> None:
    rest = "--traceback shows the whole traceback" if "call" in words else "the provider's log has the whole traceback"
    say_error(error, as_json="--json" in words, whole="--traceback" in words, rest=rest)


def main() -> None:
    """Runs the command line.

    A TRADE error is one line on stderr, and its kind decides the exit code. What a provider raises itself is its type,
    its message and its place; an error of this program has its traceback.
    """
    words = _words()
    try:
        build(_asked_for(words))()
    except TradeError as error:
        _say(error, words)
        sys.exit(next((code for kinds, code in _CODES.items() if isinstance(error, kinds)), _FAILED))
    except Exception as error:
        if not is_providers(error):
            raise
        _say(error, words)
        sys.exit(_FAILED)
    except KeyboardInterrupt:
        sys.exit(130)
