"""``trade door``: HTTP and WebSocket for those who speak nothing else."""

from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import Container
from trade.errors import ConfigurationError
from trade_gateway.cli._options import Json, room_of_extra
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import SystemChoice
from trade_gateway.cli.robots._detached import ready
from trade_gateway.process._signals import leaving, refuse_twice, settle

_LOOK_EVERY_S: Final = 1.0
_TOKENS: Final = Path("door-tokens.toml")
_NAME: Final = "door"

app = typer.Typer(
    invoke_without_command=True,
    help="Let HTTP and WebSocket clients in, each as an identity of its own.\n\n"
    "For example: trade door token anna, and then trade door",
)

TokenFile = Annotated[Path, typer.Option("--tokens", help="File of tokens; trade door token makes it.")]


@app.callback()
def door(
    context: typer.Context,
    listen: Annotated[str, typer.Option(help="HOST:PORT; beyond this host only with --tls and a policy.")] = (
        "127.0.0.1:7080"
    ),
    tokens: TokenFile = _TOKENS,
    tls: Annotated[
        Path | None,
        typer.Option(help="A folder of trade pki issue: encrypted, and its authority's certificates are let in."),
    ] = None,
    origin: Annotated[
        list[str] | None, typer.Option(help="A site whose pages may come in: http://localhost:5173. Repeatable.")
    ] = None,
    host: Annotated[list[str] | None, typer.Option(help="A further name it is called by; repeatable.")] = None,
    name: Annotated[str, typer.Option(help="Name of its container.")] = _NAME,
    as_json: Json = False,
) -> None:
    """Let HTTP and WebSocket clients into the system, until Ctrl-C."""
    if context.invoked_subcommand is not None:
        return
    out = Output(as_json=as_json)
    opened = room_of_extra("http", "trade door")
    choice: SystemChoice = context.obj
    with (
        leaving() as asked_to_leave,
        Container(choice.settings(name)) as container,
        opened.Door(
            container,
            listen=listen,
            tokens=opened.Tokens(tokens if tokens.exists() or tokens != _TOKENS else None),
            tls=tls,
            origins=origin or (),
            hosts=host or (),
        ) as standing,
    ):
        refuse_twice(container, "trade door")
        container.terminating.close = asked_to_leave.set
        settle()
        _say_ready(out, container, standing.url)
        while not asked_to_leave.wait(_LOOK_EVERY_S):
            if not standing.serving:
                raise ConfigurationError(where=standing.url, problem="the door has ended; its log says why")
        out.say("leaving")


@app.command()
def token(
    identity: Annotated[str, typer.Argument(help="The identity it is for.")],
    tokens: TokenFile = _TOKENS,
    as_json: Json = False,
) -> None:
    """Make a token for an identity. It is shown once: the file has its hash alone.

    To take it back, take its line out of the file; what its holder has moving stops then.

    For example: trade door token anna
    """
    made = room_of_extra("http", "trade door").add_token(tokens, identity)
    out = Output(as_json=as_json)
    if as_json:
        out.data({"identity": identity, "token": made})
        return
    out.say(f"{escape(identity)} is whoever shows this token; it is not shown again:\n  [bold]{made}[/]")
    out.say("for example, where DOOR is the address that trade door says:")
    out.say(f"  [bold]curl -H 'Authorization: Bearer {made}' DOOR/services[/]")


def _say_ready(out: Output, container: Container, url: str) -> None:
    if out.as_json:
        out.data({**ready(container), "url": url})
        return
    out.say(f"[bold green]the door is open[/] at {url} in system {escape(container.settings.system)}")
    if container.access.policy is None:
        out.say("there is no policy: whoever has a token may do everything")
    out.say("Ctrl-C closes it")
