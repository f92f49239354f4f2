"""The command ``trade``: bring a robot up, look at a system, call its services."""

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Final

import typer

from trade.errors import TradeError
from trade_gateway._lifeline import end_with_stdin
from trade_gateway.commands._output import UsageError, say_error
from trade_gateway.commands._system_choice import SystemChoice

__all__ = ["build", "main"]

_SERVICES: Final = "Services"
_MOTION: Final = "Locks and stops"
_ROBOTS: Final = "Robots, containers and networks"
_OPERATION: Final = "Keeping it up"
_HARDWARE: Final = "Setting hardware up"
_WATCHING: Final = "Watching and rules"
_RECORDINGS: Final = "Recordings and live views"
_RIGHTS: Final = "Identities and rights"

_COMMANDS: Final = {
    "up": (_ROBOTS, "commands._up:up"),
    "gateway": (_ROBOTS, "commands._gateway:gateway"),
    "container": (_ROBOTS, "commands._empty_container:container"),
    "start": (_ROBOTS, "commands._start:start"),
    "migrate": (_ROBOTS, "commands._migrate:migrate"),
    "door": (_ROBOTS, "commands._door:app"),
    "system": (_ROBOTS, "commands._system_commands:app"),
    "install": (_OPERATION, "commands._install:install"),
    "backup": (_OPERATION, "commands._backup:backup"),
    "restore": (_OPERATION, "commands._backup:restore"),
    "scan": (_HARDWARE, "commands._scan:scan"),
    "set-id": (_HARDWARE, "commands._scan:set_id"),
    "set-baud": (_HARDWARE, "commands._scan:set_baud"),
    "calibrate": (_HARDWARE, "commands._calibrate:calibrate"),
    "doctor": (_HARDWARE, "commands._doctor:doctor"),
    "drill": (_HARDWARE, "commands._drill:drill"),
    "conformance": (_OPERATION, "conformance._command:conformance"),
    "services": (_SERVICES, "commands._list:services"),
    "containers": (_SERVICES, "commands._list:containers"),
    "call": (_SERVICES, "commands._call:call"),
    "stream": (_SERVICES, "commands._stream:stream"),
    "ask": (_SERVICES, "commands._ask:ask"),
    "mcp": (_SERVICES, "commands._mcp:mcp"),
    "ros": (_ROBOTS, "commands._ros:ros"),
    "lock": (_MOTION, "commands._lock:lock"),
    "locks": (_MOTION, "commands._locks:locks"),
    "unlock": (_MOTION, "commands._locks:unlock"),
    "resume": (_MOTION, "commands._locks:resume"),
    "stop": (_MOTION, "commands._stop:stop"),
    "estop": (_MOTION, "commands._estop:estop"),
    "watch": (_WATCHING, "commands._watch:watch"),
    "top": (_WATCHING, "commands._top:top"),
    "notifications": (_WATCHING, "commands._watchers:notifications"),
    "hooks": (_WATCHING, "commands._watchers:hooks"),
    "record": (_RECORDINGS, "recording._record:record"),
    "foxglove": (_RECORDINGS, "recording._foxglove:foxglove"),
    "replay": (_RECORDINGS, "recording._replay:replay"),
    "export": (_RECORDINGS, "recording._export:export"),
    "tracing": (_WATCHING, "commands._trace:tracing"),
    "trace": (_WATCHING, "commands._trace:trace"),
    "logs": (_WATCHING, "commands._logs:logs"),
    "faults": (_WATCHING, "commands._fault_words:app"),
    "audit": (_WATCHING, "commands._audit:app"),
    "profile": (_WATCHING, "commands._profile:profile"),
    "rules": (_WATCHING, "commands._rules:app"),
    "pki": (_RIGHTS, "commands._pki_commands:app"),
    "policy": (_RIGHTS, "commands._policy:app"),
    "approvals": (_RIGHTS, "commands._approvals:app"),
}
"""By name: where help shows it, and the function or the group of commands that does it."""
_COMPLETED: Final = ("COMP_WORDS", "_TYPER_COMPLETE_ARGS")
"""Where shells say what is to be completed."""
_WITH_VALUE: Final = ("--system", "--connect")
"""Options of every command that take another word."""


def build(only: str | None = None) -> typer.Typer:
    """The command line.

    Args:
        only: the one command that will be asked for: what the others need is not imported. None: all of them.
    """
    made = typer.Typer(
        name="trade",
        no_args_is_help=True,
        rich_markup_mode="rich",
        help="Robots as services: bring one up, see what it offers, call it.",
        epilog="Without hardware: trade up examples/rosie.toml --sim, then in another terminal: trade services",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.callback()(options)
    for name, (panel, where) in _COMMANDS.items():
        if only is not None and name != only:
            continue
        module, _, attribute = where.partition(":")
        room = import_module(f"trade_gateway.{module}")
        does = getattr(room, attribute)
        if isinstance(does, typer.Typer):
            made.add_typer(does, name=name, rich_help_panel=panel)
        else:
            made.command(name, rich_help_panel=panel, **getattr(room, "COMMAND", {}))(does)
    return made


def __getattr__(name: str) -> typer.Typer:
    if name != "app":
        raise AttributeError(name)
    return build()


def _asked_for(words: Sequence[str]) -> str | None:
    """The command among the words of a command line; None if it is to be found out, or help is wanted about all."""
    left = iter(words)
    for word in left:
        if word in _WITH_VALUE:
            next(left, None)
        elif not word.startswith("-"):
            return word if word in _COMMANDS else None
    return None


def _words() -> Sequence[str]:
    """Of the command line, or of the one that a shell completes."""
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
        str | None, typer.Option(help="System id; containers of other systems are invisible. \\[env: TRADE_SYSTEM]")
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint of a container, such as tcp/127.0.0.1:7450; repeatable. \\[env: TRADE_CONNECT]"),
    ] = None,
    with_stdin: Annotated[
        bool, typer.Option("--with-stdin", hidden=True, help="End when standard input does.")
    ] = False,
    leased: Annotated[
        bool, typer.Option("--leased", hidden=True, help="With it: stay only as long as standard input says.")
    ] = False,
    version: Annotated[  # noqa: ARG001 - answered by its callback
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options of every command."""
    if with_stdin:
        end_with_stdin(leased=leased)
    context.obj = SystemChoice(system, connect)


def main() -> None:
    """Run the command line; errors of ours are one line on stderr and exit code 1, or 2 if its words are wrong."""
    try:
        build(_asked_for(_words()))()
    except UsageError as error:
        say_error(error)
        sys.exit(2)
    except TradeError as error:
        say_error(error)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
