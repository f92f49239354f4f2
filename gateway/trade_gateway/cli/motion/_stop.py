"""``trade stop``: stops all motion in a group."""

from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import StopReport
from trade.stop_line import StopLines, merge_reports
from trade_gateway.terminal._completion import groups
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain, say_elsewhere, say_unreached
from trade_gateway.terminal._system_choice import choice_of, visitor

_LINE_S: Final = 0.3
"""The time before it also stops over links, in seconds."""


def stop(
    context: typer.Context,
    group: Annotated[
        str, typer.Argument(autocompletion=groups, metavar="GROUP", help="Group to stop, and the groups beneath it.")
    ],
    reason: Annotated[str, typer.Option(help="Reason, for the audit record.")] = "",
    limit: Annotated[float, typer.Option(min=0.1, max=60.0, metavar="SECONDS", help="Time limit, in seconds.")] = 3.0,
    as_json: Json = False,
) -> None:
    """Stop all motion in a group at once. This needs no lock.

    The command calls all stop services of the group.
    It uses the stop line first, which works while the middleware's links are busy.
    Then it uses the links, and asks each container that it sees to stop what only that one sees.
    The exit code is not 0 if a device could not be stopped, or if there was nothing to stop.
    This is software. It is not safety-rated and does not replace a switch that cuts the power.

    For example: trade stop rosie.head, and later trade resume rosie.head
    """
    out = Output(as_json=as_json)
    settings = choice_of(context).settings()
    asked = StopLines(settings).stop(group, reason, limit)
    report = asked.wait_enough(_LINE_S)
    if not asked.is_enough():  # a container without a stop line may have a link, or see one that has
        with visitor(context) as container:
            report = merge_reports(group, [container.stop(group, reason, limit_s=limit), asked.report()])
            for sentence in () if report.complete else container.beyond():
                complain(sentence)
    if as_json:
        out.data(report)
    else:
        _say(out, report, settings.system)
    if asked.is_enough():
        say_unreached(asked.unreached())
    if not (report.stopped or report.failed):
        say_elsewhere(settings)
    if not report.complete:
        raise typer.Exit(1)


def _say(out: Output, report: StopReport, system: str) -> None:
    for name in report.stopped:
        out.say(f"stopped: {escape(name)}")
    for name, problem in report.failed.items():
        out.say(f"[bold red]FAILED: {escape(name)}: {escape(problem)}[/]")
    if not (report.stopped or report.failed):
        group = escape(report.group)
        out.say(f"[bold red]nothing was found[/] in group {group} of system {escape(system)} that can be stopped")
