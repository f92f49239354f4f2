"""``trade hub``: runs the hub of this host."""

import contextlib
import resource
from dataclasses import replace
from typing import Annotated, Final

import typer

from trade import Container
from trade_gateway.process._signals import leaving, settle
from trade_gateway.terminal._detached import Detach, detach_now, ready
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._sd_notify import Notifier
from trade_gateway.terminal._system_choice import choice_of

_LOOK_EVERY_S: Final = 1.0


def hub(
    context: typer.Context,
    name: Annotated[str, typer.Option(help="Name of its container.")] = "hub",
    detach: Detach = False,
    as_json: Json = False,
) -> None:
    """Run the hub of this host until Ctrl-C or SIGTERM.

    Containers of this user and system that start after it have one link to the hub, instead of one to each other.
    Calls, stops and e-stops within the host do not pass through it. If it ends, start it again: attached containers
    see each other again at once.

    For example: trade hub --detach
    """
    out, settings = Output(as_json=as_json), replace(choice_of(context).settings(name), hub="serve")
    if detach:
        detach_now(out, settings)
        return
    allow_many_links()
    with (
        leaving() as asked_to_leave,
        Notifier() as notifier,
        Container(settings, on_terminate=asked_to_leave.set) as running,
    ):
        settle()
        if as_json:
            out.data(ready(running))
        out.say(f"[bold green]{running.name} is up[/], the hub of this host in system {settings.system}")
        out.say("Ctrl-C leaves")
        notifier.ready(f"the hub of system {settings.system}")
        while not asked_to_leave.wait(_LOOK_EVERY_S):
            if running.healthy():
                notifier.alive()
        notifier.leaving()
        out.say("leaving")


def allow_many_links() -> None:
    """Lets this process have as many open files as the system allows: a hub has one for each container."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
