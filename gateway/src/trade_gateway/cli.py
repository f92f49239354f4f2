"""The command ``trade``: bring a robot up, look at a system, call its services."""

import sys
from typing import Annotated, Final

import typer

from trade.errors import TradeError
from trade_gateway import (
    _calibrate,
    _call,
    _doctor,
    _door,
    _empty_container,
    _estop,
    _gateway,
    _list,
    _lock,
    _locks,
    _logs,
    _migrate,
    _pki_commands,
    _policy,
    _profile,
    _rules,
    _scan,
    _start,
    _stream,
    _system_commands,
    _trace,
    _up,
    _watchers,
)
from trade_gateway._output import UsageError, say_error
from trade_gateway._system_choice import SystemChoice

__all__ = ["app", "main"]

_SERVICES: Final = "Services"
_MOTION: Final = "Locks and stops"
_ROBOTS: Final = "Robots, containers and networks"
_HARDWARE: Final = "Setting hardware up"
_WATCHING: Final = "Watching and rules"
_RIGHTS: Final = "Identities and rights"

app = typer.Typer(
    name="trade",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    help="Robots as services: bring one up, see what it offers, call it.",
    epilog="Without hardware: trade up examples/rosie.toml --sim, then in another terminal: trade services",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("up", rich_help_panel=_ROBOTS)(_up.up)
app.command("gateway", rich_help_panel=_ROBOTS)(_gateway.gateway)
app.command("container", rich_help_panel=_ROBOTS)(_empty_container.container)
app.command("start", rich_help_panel=_ROBOTS)(_start.start)
app.command("migrate", rich_help_panel=_ROBOTS)(_migrate.migrate)
app.add_typer(_door.app, name="door", rich_help_panel=_ROBOTS)
app.add_typer(_system_commands.app, name="system", rich_help_panel=_ROBOTS)
app.command("scan", rich_help_panel=_HARDWARE)(_scan.scan)
app.command("set-id", rich_help_panel=_HARDWARE)(_scan.set_id)
app.command("set-baud", rich_help_panel=_HARDWARE)(_scan.set_baud)
app.command("calibrate", rich_help_panel=_HARDWARE)(_calibrate.calibrate)
app.command("doctor", rich_help_panel=_HARDWARE)(_doctor.doctor)
app.command("services", rich_help_panel=_SERVICES)(_list.services)
app.command("containers", rich_help_panel=_SERVICES)(_list.containers)
app.command("call", context_settings={"ignore_unknown_options": True}, rich_help_panel=_SERVICES)(_call.call)
app.command("stream", rich_help_panel=_SERVICES)(_stream.stream)
app.command("lock", cls=_lock.WithCommand, rich_help_panel=_MOTION)(_lock.lock)
app.command("locks", rich_help_panel=_MOTION)(_locks.locks)
app.command("unlock", rich_help_panel=_MOTION)(_locks.unlock)
app.command("resume", rich_help_panel=_MOTION)(_locks.resume)
app.command("estop", rich_help_panel=_MOTION)(_estop.estop)
app.command("notifications", rich_help_panel=_WATCHING)(_watchers.notifications)
app.command("hooks", rich_help_panel=_WATCHING)(_watchers.hooks)
app.command("tracing", rich_help_panel=_WATCHING)(_trace.tracing)
app.command("trace", rich_help_panel=_WATCHING)(_trace.trace)
app.command("logs", rich_help_panel=_WATCHING)(_logs.logs)
app.command("profile", rich_help_panel=_WATCHING)(_profile.profile)
app.add_typer(_rules.app, name="rules", rich_help_panel=_WATCHING)
app.add_typer(_pki_commands.app, name="pki", rich_help_panel=_RIGHTS)
app.add_typer(_policy.app, name="policy", rich_help_panel=_RIGHTS)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415 - only for this option

        typer.echo(f"trade {version('trade-gateway')}")
        raise typer.Exit


@app.callback()
def options(
    context: typer.Context,
    system: Annotated[
        str | None, typer.Option(help="System id; containers of other systems are invisible. \\[env: TRADE_SYSTEM]")
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint of a container, such as tcp/127.0.0.1:7450; repeatable. \\[env: TRADE_CONNECT]"),
    ] = None,
    version: Annotated[  # noqa: ARG001 - answered by its callback
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options of every command."""
    context.obj = SystemChoice(system, connect)


def main() -> None:
    """Run the command line; errors of ours are one line on stderr and exit code 1, or 2 if its words are wrong."""
    try:
        app()
    except UsageError as error:
        say_error(error)
        sys.exit(2)
    except TradeError as error:
        say_error(error)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
