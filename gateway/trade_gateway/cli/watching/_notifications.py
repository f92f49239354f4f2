"""``trade notifications`` and ``trade hooks``: list the notifications and hooks of a system, and end them."""

from typing import Annotated

import typer
from rich.markup import escape

from trade import HookInfo, NotificationInfo
from trade_gateway.terminal import _completion as completion
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor_among_others


def notifications(
    context: typer.Context,
    cancel: Annotated[
        str | None,
        typer.Option(metavar="ID", autocompletion=completion.notifications, help="Cancel this one, in any container."),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the notifications of the system: event, call, owner and counts.

    For example: trade notifications --cancel 5c1f09ae37b2.1
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        if cancel is not None:
            container.cancel_notification(cancel)
            out.say(f"cancelled: {escape(cancel)}")
            return
        found = container.notifications()
    if as_json:
        out.data(found)
    elif not found:
        out.say("there is no notification")
    else:
        columns = (
            "ID",
            "OCCASION",
            "CALL",
            "CONDITION",
            "FIRED",
            "FAILED",
            "STATE",
            "CONTAINER",
            "OWNER",
            "LAST ERROR",
        )
        out.table(columns, [_notification(info) for info in found])


def _notification(info: NotificationInfo) -> tuple[str, ...]:
    return (
        info.id,
        info.occasion,
        info.call,
        info.condition,
        str(info.fired),
        str(info.failures),
        f"{info.state}, detached" if info.detached else info.state,
        info.container,
        info.owner,
        info.last_error,
    )


def hooks(
    context: typer.Context,
    detach: Annotated[
        str | None,
        typer.Option(metavar="ID", autocompletion=completion.hooks, help="Detach this one, in any container."),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the hooks of the system: target, call, owner, state and counts.

    For example: trade hooks --detach 5c1f09ae37b2.h1
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        if detach is not None:
            container.detach_hook(detach)
            out.say(f"detached: {escape(detach)}")
            return
        found = [info for info in container.hooks() if info.container != container.name]
    if as_json:
        out.data(found)
    elif not found:
        out.say("no hook is attached")
    else:
        columns = ("ID", "SIDE", "TARGET", "CALL", "FIRED", "FAILED", "STATE", "CONTAINER", "OWNER", "LAST ERROR")
        out.table(columns, [_hook(info) for info in found])


def _hook(info: HookInfo) -> tuple[str, ...]:
    return (
        info.id,
        info.side,
        info.target,
        info.call,
        str(info.fired),
        str(info.failures),
        "suspended" if info.suspended else "attached",
        info.container,
        info.owner,
        info.last_error,
    )
