"""``trade use SYSTEM``: chooses the system of this user's programs, instead of environment variables."""

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from trade import Settings
from trade.atomic_files import replace
from trade.default_system import CHOSEN, chosen_file, chosen_settings
from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import choice_of

_MODE = 0o600


def use(
    context: typer.Context,
    system: Annotated[str | None, typer.Argument(help="System id; by default, show what is in use.")] = None,
    connect: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help="Endpoint to connect to. Repeatable.")
    ] = None,
    tls: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder of the certificate.")] = None,
    policy: Annotated[Path | None, typer.Option(metavar="FILE", help="File of the access policy.")] = None,
    clear: Annotated[bool, typer.Option("--clear", help="End the choice.")] = False,
    as_json: Json = False,
) -> None:
    """Choose the system of your programs and commands, until you choose another.

    It applies where neither an option nor TRADE_SYSTEM names a system. Without a system, it shows what is in use.

    For example: trade use lab
    """
    out = Output(as_json=as_json)
    file = chosen_file(os.environ)
    if file is None:
        raise ConfigurationError(where="trade use", problem="this user has no home directory; set XDG_CONFIG_HOME")
    if system is None and (connect or tls or policy):
        raise UsageError(where="trade use", problem="name the system, too: trade use lab --connect ENDPOINT")
    if system is not None and clear:
        raise UsageError(where="trade use", problem="give a system, or --clear to end the choice; not both")
    if clear:
        file.unlink(missing_ok=True)
    elif system is not None:
        given = (system, ",".join(connect or []), tls and str(tls.absolute()), policy and str(policy.absolute()))
        chosen = {name: str(value) for name, value in zip(CHOSEN, given, strict=True) if value}
        Settings.read(environment=chosen)
        file.parent.mkdir(parents=True, exist_ok=True)
        replace(file, "".join(f"{name} = {_quoted(value)}\n" for name, value in chosen.items()).encode(), _MODE)
    _show(context, out, file)


def _quoted(text: str) -> str:
    if not text.isprintable() or '"' in text or "\\" in text:
        raise UsageError(where="trade use", problem=f"{text!r} has characters that a setting cannot have")
    return f'"{text}"'


def _show(context: typer.Context, out: Output, file: Path) -> None:
    """What is in use, and where it comes from."""
    choice = choice_of(context)
    settings = choice.settings()
    if choice.system:
        source = "the option --system"
    elif os.environ.get(CHOSEN[0]):
        source = f"the environment variable {CHOSEN[0]}"
    elif chosen_settings(os.environ):
        source = f"trade use ({file})"
    else:
        source = "the default: your user and this host"
    found = {"system": settings.system, "source": source, "connect": settings.connect, "identity": settings.identity}
    if out.as_json:
        out.data(found)
    else:
        out.say(f"in use: [bold]{escape(settings.system)}[/], by {escape(source)}")
        for endpoint in settings.connect:
            out.say(f"  connects to {escape(endpoint)}")
        out.say(f"  as {escape(settings.identity)}")
