"""``trade conformance --peer COMMAND``: does a container in another language keep the rules?"""

import signal
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.markup import escape

from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json, chosen
from trade_gateway.cli._output import Output
from trade_gateway.conformance import CHECKS, FAILED, LEFT_OUT, OK, Check, Outcome, run

_COLOURS = {OK: "green", FAILED: "bold red", LEFT_OUT: "yellow"}


def conformance(
    peer: Annotated[
        str | None, typer.Option(metavar="COMMAND", help="Starts the container to be checked; words as in a shell.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="CHECK", help="Only this check; again for another.")] = None,
    motion: Annotated[
        bool, typer.Option("--motion", help="Also turn the arm, by up to 30 rad: only where nothing real can move.")
    ] = False,
    listed: Annotated[bool, typer.Option("--list", help="Only say which checks there are.")] = False,
    as_json: Json = False,
) -> None:
    """Start a container written in whatever language, and check from outside that it keeps the rules.

    It runs in a system of its own on this host and is told by the environment where that is; docs/wire-protocol.md says
    which services it offers for this. Nothing moves without --motion, and most checks of safety need it. The exit code
    is 1 if a check fails.

    For example: trade conformance --peer peers/rust/target/debug/trade-peer --motion
    """
    out = Output(as_json=as_json)
    if listed:
        _list(out)
        return
    if peer is None:
        raise UsageError(
            where="--peer", problem="missing; name the command that starts a container, or --list the checks"
        )
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that nobody is left behind
    outcomes = run(peer, _chosen(only or [], motion=motion), lambda outcome: _tell(out, outcome), motion=motion)
    failed = [outcome.check for outcome in outcomes if outcome.outcome == FAILED]
    if failed:
        out.say(f"[bold red]failed[/]: {len(failed)} of {len(outcomes)}: {escape(', '.join(failed))}")
        raise typer.Exit(1)
    left_out = [outcome.check for outcome in outcomes if outcome.outcome == LEFT_OUT]
    out.say(f"[bold green]passed[/]: {len(outcomes) - len(left_out)} checks, {len(left_out)} left out")
    if not motion and left_out:
        out.say("[yellow]nothing is known of its stops and locks[/]: checks of motion need --motion")


def _chosen(names: Sequence[str], *, motion: bool) -> list[Check]:
    """The checks asked for, in the order of the table. Raises UsageError."""
    checks = chosen(CHECKS, names, "check")
    if names and not motion and (moving := [one.name for one in checks if not one.still]):
        problem = "is a check of motion; add --motion where the arm may turn"
        raise UsageError(where=f"--only {moving[0]}", problem=problem)
    return checks


def _list(out: Output) -> None:
    if out.as_json:
        out.data([{"check": one.name, "rule": one.rule, "what": one.what, "motion": not one.still} for one in CHECKS])
        return
    rows = [(one.name, one.rule, "" if one.still else "yes", one.what) for one in CHECKS]
    out.table(("CHECK", "RULE", "MOTION", "WHAT"), rows)


def _tell(out: Output, outcome: Outcome) -> None:
    if out.as_json:
        out.data(outcome)
        return
    why = f": {escape(outcome.why)}" if outcome.why else ""
    out.say(f"[{_COLOURS[outcome.outcome]}]{outcome.outcome:<8}[/] {outcome.check:<20} {escape(outcome.what)}{why}")
