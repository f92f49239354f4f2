"""``trade http``: the HTTP gateway, which serves HTTP and WebSocket clients and the dashboard."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import Container
from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.process._signals import leaving, refuse_twice, settle
from trade_gateway.terminal import sections
from trade_gateway.terminal._detached import ready
from trade_gateway.terminal._options import CONNECTION, SECURITY, Json, room_of_extra
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import SystemChoice

SECTION: Final = sections.ROBOTS
PLACE: Final = 8
_LOOK_EVERY_S: Final = 1.0
_TOKENS: Final = Path("http-tokens.toml")
_NAME: Final = "http"
AGENTS: Final = "Agents"

app = typer.Typer(
    invoke_without_command=True,
    help="Serve HTTP and WebSocket clients and the dashboard.\n\n"
    "For example: trade http token anna, and then trade http",
)

TokenFile = Annotated[
    Path, typer.Option("--tokens", rich_help_panel=SECURITY, help="File of tokens, which trade http token makes.")
]


@app.callback()
def http(
    context: typer.Context,
    listen: Annotated[
        str,
        typer.Option(rich_help_panel=CONNECTION, help="HOST:PORT to listen on; other hosts need --tls and a policy."),
    ] = ("127.0.0.1:7080"),
    port: Annotated[str | None, typer.Option("--port", hidden=True)] = None,
    tokens: TokenFile = _TOKENS,
    tls: Annotated[
        Path | None,
        typer.Option(
            rich_help_panel=SECURITY,
            help="Certificate folder of trade pki issue. Also accepts its authority's client certificates.",
        ),
    ] = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(rich_help_panel=SECURITY, help="Allowed origin of web pages: http://localhost:5173. Repeatable."),
    ] = None,
    host: Annotated[
        list[str] | None, typer.Option(rich_help_panel=CONNECTION, help="Further host name of this server. Repeatable.")
    ] = None,
    mcp: Annotated[
        bool, typer.Option("--mcp", rich_help_panel=AGENTS, help="Serve agents at /mcp (Model Context Protocol).")
    ] = False,
    ask_first: Annotated[
        list[str] | None,
        typer.Option(
            rich_help_panel=AGENTS,
            help="Require approval (trade approvals) for agents' calls to this group. Repeatable.",
        ),
    ] = None,
    twin: Annotated[
        Path | None,
        typer.Option(rich_help_panel=AGENTS, metavar="ROBOT.toml", help="Robot file to simulate for agents' dry runs."),
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the gateway's container.")] = _NAME,
    as_json: Json = False,
) -> None:
    """Serve HTTP and WebSocket clients until Ctrl-C."""
    if context.invoked_subcommand is not None:
        return
    if port is not None:  # as other servers have it; click would suggest --host
        raise UsageError(where="--port", problem=f"it is --listen HOST:PORT here: --listen 127.0.0.1:{port}")
    out = Output(as_json=as_json)
    opened = room_of_extra("http", "trade http")
    _check_agents(mcp=mcp, ask_first=ask_first or (), twin=twin)
    choice: SystemChoice = context.obj
    with (
        leaving() as asked_to_leave,
        Container(choice.settings(name), on_terminate=asked_to_leave.set) as container,
        opened.HttpGateway(
            container,
            listen=listen,
            tokens=opened.Tokens(tokens if tokens.exists() or tokens != _TOKENS else None),
            tls=tls,
            origins=origin or (),
            hosts=host or (),
            mcp=mcp,
            ask_first=ask_first or (),
            twin=twin,
        ) as standing,
    ):
        refuse_twice(container, "trade http")
        settle()
        _say_ready(out, container, standing.url)
        while not asked_to_leave.wait(_LOOK_EVERY_S):
            if not standing.serving:
                raise ConfigurationError(where=standing.url, problem="the HTTP gateway has ended; its log says why")
        out.say("leaving")


def _check_agents(*, mcp: bool, ask_first: Sequence[str], twin: Path | None) -> None:
    """Raises ConfigurationError: options for agents without agents, no extra ``mcp``, or no such robot file."""
    if mcp:
        room_of_extra("mcp", "trade http --mcp")
    elif ask_first or twin is not None:
        raise ConfigurationError(where="trade http", problem="--ask-first and --twin are for agents. Add --mcp")
    if twin is not None and not twin.exists():
        raise ConfigurationError(where=str(twin), problem="there is no such robot file")


@app.command()
def token(
    identity: Annotated[str, typer.Argument(help="Identity of the client.")],
    tokens: TokenFile = _TOKENS,
    as_json: Json = False,
) -> None:
    """Make a token for an identity. It is shown once; the file keeps only its hash.

    To revoke the token, remove its line from the file. Motion of its client stops then.

    For example: trade http token anna
    """
    made = room_of_extra("http", "trade http").add_token(tokens, identity)
    out = Output(as_json=as_json)
    if as_json:
        out.data({"identity": identity, "token": made})
        return
    out.say(f"token of {escape(identity)}; it is not shown again:\n  [bold]{made}[/]")
    out.say("for example, where URL is the address that trade http prints:")
    out.say(f"  [bold]curl -H 'Authorization: Bearer {made}' URL/services[/]")


def _say_ready(out: Output, container: Container, url: str) -> None:
    if out.as_json:
        out.data({**ready(container), "url": url})
        return
    out.say(f"[bold green]the HTTP gateway is up[/] at {url} in system {escape(container.settings.system)}")
    if container.access.policy is None:
        out.say("there is no policy: every client with a token may do everything")
    out.say("Ctrl-C ends it")
