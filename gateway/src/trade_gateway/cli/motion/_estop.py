"""``trade estop``: stop the whole system, and clear that again."""

from typing import Annotated

import typer
from rich.markup import escape

from trade import Container, EstopReport, Reachability
from trade._estop.controller import new_estop_id
from trade._stop_line import StopLines
from trade.errors import NoSuchEstop
from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import choice_of, visitor


def estop(
    context: typer.Context,
    ids: Annotated[list[str] | None, typer.Argument(metavar="[ID]...", help="With --clear: which; else all.")] = None,
    reason: Annotated[str, typer.Option(help="Why, for people.")] = "",
    clear: Annotated[bool, typer.Option("--clear", help="Clear open e-stops. Nothing moves by itself.")] = False,
    limit: Annotated[float, typer.Option(min=0.1, max=60.0, help="Seconds to try.")] = 3.0,
    as_json: Json = False,
) -> None:
    """Stop everything in the system at once, and let nothing move before it is cleared.

    The exit code is not 0 if a container did not confirm, could not stop something, or if none was found; also if
    nobody answers at one of the endpoints of TRADE_CONNECT: who is there was told nothing, and tells nothing.
    This is software: it is not safety-rated and replaces no switch that cuts the power.

    For example: trade estop --reason "smoke", and later trade estop --clear
    """
    _check_words(ids, reason, clear=clear)
    out = Output(as_json=as_json)
    given = "" if clear else _given(context, reason, limit)
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
            reachability = container.reachability(limit_s=0)  # only now: an order waits for nobody
    if reachability.apart and not clear:
        raise reachability.nobody(system, "who is there was not told to stop; use the switch that cuts the power")
    if clear and not reachability.complete:
        raise reachability.nobody(system, "what is open there stays open until it is cleared once more")
    if not report.complete or not (clear or _known(report, container.address.who)):
        raise typer.Exit(1)


def _check_words(ids: list[str] | None, reason: str, *, clear: bool) -> None:
    if ids and not clear:
        raise UsageError(where="trade estop", problem="ids are for clearing: trade estop --clear ID")
    if reason and clear:
        raise UsageError(where="trade estop", problem="--reason is for stopping, and --clear clears")


def _given(context: typer.Context, reason: str, limit_s: float) -> str:
    """Give an e-stop on the stop line, before there is a link; its id, under which it is given again on the links."""
    estop_id = new_estop_id()
    StopLines(choice_of(context).settings()).estop(estop_id, reason, limit_s)
    return estop_id


def _clear(container: Container, found: Reachability, ids: list[str] | None, limit_s: float) -> EstopReport | None:
    """Clear those, or all that are open; None: none is, say all that there are.

    Raises:
        NobodyFound: nobody was found, or not everybody, and none of those knows it.
        NoSuchEstop: everybody was asked, and nobody knows it.
    """
    system, cannot_tell = container.settings.system, "so nobody can tell whether an e-stop is open; none was cleared"
    wanted = ids or [known.id for known in container.estops()]
    if not found.others or not (wanted or found.complete):
        raise found.nobody(system, cannot_tell)
    try:
        return container.estop_clear(wanted, limit_s=limit_s) if wanted else None
    except NoSuchEstop:
        if found.complete:
            raise
        raise found.nobody(system, cannot_tell) from None


def _say(out: Output, report: EstopReport, system: str, done: str, own: str) -> None:
    others = [name for name in report.confirmed if name != own]  # that this command has heard of it itself says nothing
    for name in others or report.confirmed:
        out.say(f"{done}: {escape(name)}{_version(report, name)}")
    for name, problem in report.failed.items():
        out.say(f"[bold red]FAILED: {escape(name)}{_version(report, name)}: {escape(problem)}[/]")
    for name in report.missing:
        hears = done == "stopped" or name not in report.versions
        missed = "did not answer" if hears else "is cleared by a `trade` of its version only"
        out.say(f"[bold red]MISSING: {escape(name)}{_version(report, name)} {missed}[/]")
    if report.apart:
        out.say(f"{len(report.apart)} that said nothing may offer nothing, so there is nothing of theirs to stop")
    known = _known(report, own)
    if not known:
        out.say(f"[bold red]nobody was found[/] in system {escape(system)} that has something to stop")
    if done == "cleared" and others:
        out.say("nothing moves by itself: what others had in use waits for [bold]trade resume GROUP[/]")
    clear = f"[bold]trade estop --clear {report.id}[/]"
    if done == "stopped" and known:
        out.say(f"e-stop {report.id} is open; when it is safe: {clear}")
    elif done == "stopped":
        out.say("[bold red]NOT GIVEN to anybody that is known: use the switch that cuts the power[/]")
        out.say(f"whoever was out of sight may have heard e-stop {report.id} all the same, and then needs {clear}")


def _known(report: EstopReport, own: str) -> set[str]:
    """Who is known to have been told, or to be there; that this command has heard of it itself says nothing."""
    return {*report.confirmed, *report.missing, *report.failed} - {own}


def _version(report: EstopReport, name: str) -> str:
    """Of the protocol, if it is another one than that of this command."""
    return f" (protocol version {report.versions[name]})" if name in report.versions else ""
