"""``trade estop``: stops the whole system, and clears e-stops."""

from typing import Annotated

import typer
from rich.markup import escape

from trade import Container, EstopReport, Reachability
from trade.errors import NoSuchEstop
from trade.protocol.estop_messages import new_estop_id
from trade.stop_line import StopLines
from trade_gateway._usage import UsageError
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, say_elsewhere, say_unreached
from trade_gateway.terminal._system_choice import choice_of, visitor


def estop(
    context: typer.Context,
    ids: Annotated[
        list[str] | None, typer.Argument(metavar="ID", help="With --clear: e-stop ids; by default all.")
    ] = None,
    reason: Annotated[str, typer.Option(help="Reason, shown to people.")] = "",
    clear: Annotated[bool, typer.Option("--clear", help="Clear open e-stops. This moves nothing.")] = False,
    limit: Annotated[float, typer.Option(min=0.1, max=60.0, metavar="SECONDS", help="Time limit, in seconds.")] = 3.0,
    as_json: Json = False,
) -> None:
    """Stop the whole system at once. Nothing moves until the e-stop is cleared.

    The exit code is not 0 if a container did not confirm or could not stop a device, or if none was found.
    It uses the stop line first, and waits for no link if all confirm there. It warns of dead endpoints.
    If a link is needed, a dead endpoint makes the exit code not 0: containers there did not receive the e-stop.
    This is software. It is not safety-rated and does not replace a switch that cuts the power.

    For example: trade estop --reason "smoke", and later trade estop --clear
    """
    _check_words(ids, reason, clear=clear)
    out = Output(as_json=as_json)
    given = new_estop_id()
    if not clear and _stopped_by_line(context, out, given, reason, limit):
        return
    with visitor(context) as container:
        system = container.settings.system
        reachability = container.reachability(limit_s=limit) if clear else None
        if reachability is None:
            report = container.estop(reason, limit_s=limit, estop_id=given)
        else:
            report = _clear(container, reachability, ids, limit)
        if report is None:
            if as_json:
                out.data(None)
            out.say(f"no e-stop is open in system {escape(system)}")
            return
        if as_json:
            out.data(report)
        else:
            _say(out, report, system, "cleared" if clear else "stopped", container.address.who)
        if reachability is None:
            reachability = container.reachability(limit_s=0)  # only now, so that it does not delay the e-stop
    _end(report, reachability, container, clear=clear)


def _end(report: EstopReport, found: Reachability, container: Container, *, clear: bool) -> None:
    """Ends the command with an error or another exit code than 0, unless all containers are known to have done it."""
    system, known = container.settings.system, _known(report, container.address.who)
    if not (clear or known):
        say_elsewhere(container.settings)
    if found.unreached and not clear:
        raise found.as_error(system, "containers there were not stopped; use the switch that cuts the power")
    if clear and not found.complete:
        raise found.as_error(system, "an e-stop that is open there stays open; clear it again when they answer")
    if not report.complete or not (clear or known):
        raise typer.Exit(1)


def _check_words(ids: list[str] | None, reason: str, *, clear: bool) -> None:
    if ids and not clear:
        raise UsageError(where="trade estop", problem="ids are for clearing: trade estop --clear ID")
    if reason and clear:
        raise UsageError(where="trade estop", problem="--reason is for a new e-stop; leave it out with --clear")


def _stopped_by_line(context: typer.Context, out: Output, estop_id: str, reason: str, limit_s: float) -> bool:
    """Sends an e-stop on the stop line, before any link; prints the report and returns True if that is enough.

    Otherwise it is sent again on the links, with the same id.
    """
    settings = choice_of(context).settings()
    lines = StopLines(settings)
    asked = lines.estop(estop_id, reason, limit_s)
    linked = lines.without_line()
    report = asked.wait_enough()
    if any(linked.values()) or not asked.is_enough():
        return False
    if out.as_json:
        out.data(report)
    else:
        _say(out, report, settings.system, "stopped", "")
    say_unreached([*asked.unreached(), *linked])
    say_elsewhere(settings, earlier=True)  # the e-stop has to be cleared there, too
    return True


def _clear(container: Container, found: Reachability, ids: list[str] | None, limit_s: float) -> EstopReport | None:
    """Clears these e-stops, or all open ones; None: all containers report that none is open.

    Raises:
        NoContainerFound: some or all containers were not found, and no other one knows the e-stop.
        NoSuchEstop: all containers were asked, and none knows it.
    """
    system, cannot_tell = container.settings.system, "so it is unknown whether an e-stop is open; none was cleared"
    wanted = ids or [known.id for known in container.estops()]
    if not found.others or not (wanted or found.complete):
        say_elsewhere(container.settings)
        raise found.as_error(system, cannot_tell)
    try:
        return container.estop_clear(wanted, limit_s=limit_s) if wanted else None
    except NoSuchEstop:
        if found.complete:
            raise
        raise found.as_error(system, cannot_tell) from None


def _say(out: Output, report: EstopReport, system: str, done: str, own: str) -> None:
    others = [name for name in report.confirmed if name != own]  # this command's own confirmation says nothing
    for name in others or report.confirmed:
        out.say(f"{done}: {escape(name)}{_version(report, name)}")
    for name, problem in report.failed.items():
        out.say(f"[bold red]FAILED: {escape(name)}{_version(report, name)}: {escape(problem)}[/]")
    for name in report.missing:
        hears = done == "stopped" or name not in report.versions
        problem = "did not answer" if hears else "can be cleared only by a `trade` of its own version"
        out.say(f"[bold red]MISSING: {escape(name)}{_version(report, name)} {problem}[/]")
    if report.without_services:
        count = len(report.without_services)
        out.say(f"{count} containers did not answer; they may offer no services, so nothing to stop")
    known = _known(report, own)
    if not known:
        out.say(f"[bold red]no container was found[/] in system {escape(system)} that has something to stop")
    if done == "cleared" and others:
        out.say("nothing moves by itself; to let a group of other clients move again: [bold]trade resume GROUP[/]")
    clear = f"[bold]trade estop --clear {report.id}[/]"
    if done == "stopped" and known:
        out.say(f"e-stop {report.id} is open; when it is safe: {clear}")
    elif done == "stopped":
        out.say("[bold red]NOT RECEIVED by any known container: use the switch that cuts the power[/]")
        out.say(f"an unseen container may still have received e-stop {report.id}; to clear it: {clear}")


def _known(report: EstopReport, own: str) -> set[str]:
    """Returns the containers that are known to exist, without this command's own."""
    return {*report.confirmed, *report.missing, *report.failed} - {own}


def _version(report: EstopReport, name: str) -> str:
    """Returns the container's protocol version, if this command has another one."""
    return f" (protocol version {report.versions[name]})" if name in report.versions else ""
