"""``trade mcp``: a Model Context Protocol (MCP) server for agents, on standard input and output."""

from pathlib import Path
from typing import Annotated, Final

import typer

from trade import Container
from trade.errors import ConfigurationError
from trade_gateway.language import read_lexicon
from trade_gateway.process._signals import settle
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import room_of_extra
from trade_gateway.terminal._output import complain
from trade_gateway.terminal._system_choice import SystemChoice

SECTION: Final = sections.SERVICES
PLACE: Final = 7


def mcp(
    context: typer.Context,
    name: Annotated[str, typer.Option(help="Name of the server's container.")] = "agent",
    ask_first: Annotated[
        list[str] | None,
        typer.Option(help="Require human approval (trade approvals) for calls to this group. Repeatable."),
    ] = None,
    twin: Annotated[
        Path | None, typer.Option(metavar="ROBOT.toml", help="Robot file to simulate for dry runs.")
    ] = None,
    lexicon: Annotated[Path | None, typer.Option(help="TOML file of phrases for the tool ask.")] = None,
) -> None:
    """Serve the system to an agent over the Model Context Protocol (MCP).

    The agent's client starts this command. The agent can read, and can move under locks what the policy allows.
    Its identity is that of this process. When the client disconnects, the agent's motion stops.

    For example: trade mcp --twin rosie.toml --ask-first rosie.legs
    """
    room = room_of_extra("mcp", "trade mcp")
    from anyio import run  # noqa: PLC0415 - the extra installs it

    choice: SystemChoice = context.obj
    if twin is not None and not twin.exists():
        raise ConfigurationError(where=str(twin), problem="there is no such robot file")
    trying = None if twin is None else room.Twin(twin)
    with Container(choice.settings(name)) as container:
        if container.access.policy is None and not ask_first:
            complain("there is no policy: this agent may call every service that it has locked; see docs/agents.md")
        if container.access.policy is None and ask_first:
            complain(f"there is no policy: approve calls under another identity than {container.address.identity}")
        approvals = room.Approvals(container, ask_first or ())

        def leave() -> None:
            if trying is not None:
                trying.close()
            container.close()

        settle()
        try:
            run(room.serve, container, approvals, read_lexicon(lexicon), trying, leave)
        finally:
            leave()
