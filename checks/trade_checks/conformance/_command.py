"""``trade conformance --peer COMMAND``: tests whether a container in another language keeps the protocol's rules."""

import signal
from collections.abc import Sequence
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade_checks._cases import chosen
from trade_checks.conformance import CHECKS, Check, Outcome, Result, run
from trade_gateway._usage import UsageError
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output

SECTION: Final = sections.OPERATION
_COLOURS = {Result.OK: "green", Result.FAILED: "bold red", Result.LEFT_OUT: "yellow"}


def conformance(
    peer: Annotated[
        str | None, typer.Option(metavar="COMMAND", help="Command that starts the container to check.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="CHECK", help="Run only this check. Repeatable.")] = None,
    motion: Annotated[
        bool, typer.Option("--motion", help="Also turn the arm by up to 30 rad; only where nothing real can move.")
    ] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the checks and exit.")] = False,
    as_json: Json = False,
) -> None:
    """Check that a container in any language keeps the protocol's rules.

    The container runs on this host in its own system, whose settings it gets in the environment.
    docs/wire-protocol.md lists the services that it must offer. Nothing moves without --motion.
    Most safety checks need --motion. The exit code is 1 if a check fails.

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
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that no process is left behind
    outcomes = run(peer, _chosen(only or [], motion=motion), lambda outcome: _print(out, outcome), motion=motion)
    failed = [outcome.check for outcome in outcomes if outcome.outcome is Result.FAILED]
    if failed:
        out.say(f"[bold red]failed[/]: {len(failed)} of {len(outcomes)}: {escape(', '.join(failed))}")
        raise typer.Exit(1)
    left_out = [outcome.check for outcome in outcomes if outcome.outcome is Result.LEFT_OUT]
    out.say(f"[bold green]passed[/]: {len(outcomes) - len(left_out)} checks, {len(left_out)} left out")
    if not motion and left_out:
        out.say("[yellow]its stops and locks were not checked[/]: checks of motion need --motion")


def _chosen(names: Sequence[str], *, motion: bool) -> list[Check]:
    """Returns the requested checks in the order of the table. Raises UsageError."""
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


def _print(out: Output, outcome: Outcome) -> None:
    if out.as_json:
        out.data(outcome)
        return
    why = f": {escape(outcome.why)}" if outcome.why else ""
    result = outcome.outcome
    out.say(f"[{_COLOURS[result]}]{result.value:<8}[/] {outcome.check:<20} {escape(outcome.what)}{why}")
