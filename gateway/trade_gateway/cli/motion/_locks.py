"""``trade locks``, ``unlock`` and ``resume``: list locks, break them, and release groups after a stop."""

from functools import partial, reduce
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import Constraint, Container, LockInfo
from trade.timestamps import clock
from trade_gateway._usage import asked_for
from trade_gateway.terminal._completion import groups, locked_groups
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor_among_others

_GROUP_HELP: Final = "A group, with the groups beneath it: rosie.head."
_GROUPS_HELP: Final = "Groups, each with the groups beneath it: rosie.head."
Locked = Annotated[str, typer.Argument(autocompletion=locked_groups, help=_GROUP_HELP)]
_WAIT_S: Final = 2.0
"""How long each of several groups is waited for, as `Container.resume` waits for one."""


def locks(context: typer.Context, as_json: Json = False) -> None:
    """List locks with owner, purpose, remaining lease and waiting clients.

    Resources that could not be stopped have no owner. They cannot be locked until `trade resume`.

    For example: trade locks --json
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        found = container.locks()
    if as_json:
        out.data([_plain(info) for info in found])
    elif not found:
        out.say("nothing is locked")
    else:
        columns = ("RESOURCES", "OWNER", "PURPOSE", "SINCE", "LEASE LEFT", "CONTAINER", "WAITING")
        out.table(columns, [_row(info) for info in found])


def _owner(info: LockInfo) -> str:
    return info.holder.owner


def _plain(info: LockInfo) -> dict[str, object]:
    return {
        "resources": info.resources,
        "owner": _owner(info),
        "purpose": info.holder.purpose,
        "since": info.holder.since,
        "lease_left_s": info.left_s,
        "container": info.container,
        "uses": info.uses,
        "waiting": info.waiting,
    }


def _row(info: LockInfo) -> tuple[str, ...]:
    return (
        ", ".join(info.resources),
        _owner(info),
        info.holder.purpose,
        clock(info.holder.since),
        f"{info.left_s:.1f} s" if info.token.number else "",  # a blocked resource has no lease
        info.container,
        ", ".join(info.waiting),
    )


def unlock(
    context: typer.Context,
    group: Locked,
    reason: Annotated[str, typer.Option("--break", metavar="REASON", help="Reason, reported to the owner.")],
) -> None:
    """Break the locks of a group; motion under them is stopped.

    For example: trade unlock rosie.head --break "its program hangs"
    """
    out = Output(as_json=False)
    with visitor_among_others(context) as container:
        broken = container.break_lock(_there(container, group), reason)
    for info in broken:
        out.say(f"taken from {escape(_owner(info))}: {escape(', '.join(info.resources))}")
    if not broken:
        out.say(f"nothing of {escape(group)} was locked")


def _there(container: Container, group: str) -> Constraint:
    """Returns the constraint of a group that has services. Raises NoSuchService, with similar names."""
    constraint = asked_for(f"group {group!r}", group=group, name=None)
    container.await_services(constraint, partial(_has_services, container, constraint), 0.0)
    return constraint


def _has_services(container: Container, which: Constraint) -> bool:
    return bool(container.services(which))


def resume(
    context: typer.Context,
    groups: Annotated[list[str], typer.Argument(metavar="GROUP...", autocompletion=groups, help=_GROUPS_HELP)],
) -> None:
    """Let groups move again after another client's stop; move nothing.

    If a group does not exist, nothing is resumed.
    The exit code is 1 while an e-stop is open: nothing moves until it is cleared.

    For example: trade resume rosie.head
    """
    out = Output(as_json=False)
    with visitor_among_others(context) as container:
        wanted = [asked_for(f"group {group!r}", group=group, name=None) for group in groups]
        for one in wanted if len(wanted) > 1 else ():
            container.await_services(one, partial(_has_services, container, one), _WAIT_S)
        resumed = container.resume(reduce(Constraint.__or__, wanted))
        still = container.estops()
    for estop in still:
        why = f": {escape(estop.reason)}" if estop.reason else ""
        out.say(f"[bold red]e-stop {estop.id} is open{why}; nothing moves before it is cleared[/]")
    if still:
        if resumed:
            out.say(f"resumed, for when it is: {escape(', '.join(resumed))}")
        out.say(f"when it is safe: [bold]trade estop --clear {' '.join(estop.id for estop in still)}[/]")
        raise typer.Exit(1)
    out.say(
        f"may move again: {escape(', '.join(resumed))}"
        if resumed
        else f"nothing of {escape(', '.join(groups))} was held"
    )
