"""``trade mcp``: a system for an agent, over the Model Context Protocol on standard input and output."""

from pathlib import Path
from typing import Annotated

import anyio
import typer

from trade import Container
from trade.errors import ConfigurationError
from trade_gateway.cli._options import room_of_extra
from trade_gateway.cli._output import complain
from trade_gateway.cli._system_choice import SystemChoice
from trade_gateway.language import read_lexicon
from trade_gateway.process._signals import settle


def mcp(
    context: typer.Context,
    name: Annotated[str, typer.Option(help="Name of its container.")] = "agent",
    ask_first: Annotated[
        list[str] | None,
        typer.Option(help="A group of which nothing is called without a person's word (trade approvals). Repeatable."),
    ] = None,
    twin: Annotated[
        Path | None, typer.Option(metavar="ROBOT.toml", help="Dry runs are made on a simulation of this robot.")
    ] = None,
    lexicon: Annotated[Path | None, typer.Option(help="Phrases for the tool ask that go before those known.")] = None,
) -> None:
    """Let an agent look at the system and, under locks, move what it may; its client starts this as a program.

    The agent is whoever this process is (--tls of its settings): policy, audit and locks know it by that name.
    When its client goes away, what it has set moving stops.

    For example: trade mcp --twin rosie.toml --ask-first rosie.legs
    """
    room = room_of_extra("mcp", "trade mcp")
    choice: SystemChoice = context.obj
    if twin is not None and not twin.exists():
        raise ConfigurationError(where=str(twin), problem="there is no such robot file")
    trying = None if twin is None else room.Twin(twin)
    with Container(choice.settings(name)) as container:
        if container.access.policy is None and not ask_first:
            complain("there is no policy: this agent may call everything it has locked; see docs/agents.md")
        if container.access.policy is None and ask_first:
            complain(f"there is no policy: approve under another identity than {container.address.identity}")
        approvals = room.Approvals(container, ask_first or ())

        def leave() -> None:
            if trying is not None:
                trying.close()
            container.close()

        settle()
        try:
            anyio.run(room.serve, container, approvals, read_lexicon(lexicon), trying, leave)
        finally:
            leave()
