"""``trade faults``: lists and shows the faults of devices with their measurements, and acknowledges them."""

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.markup import escape

from trade import Container, where
from trade.errors import InvalidArgument, TradeError, as_commands
from trade.timestamps import day_and_clock
from trade_gateway._usage import UsageError, asked_for
from trade_gateway.terminal._options import FirstByDefault, Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._system_choice import visitor_among_others

if TYPE_CHECKING:
    from trade import Handle
    from trade_drivers import Fault, FaultInfo, FaultSample

_WAIT_S: Final = 5.0
_SHOWN: Final = 20
"""How many samples are shown; with ``--json`` all."""

Id = Annotated[str, typer.Argument(metavar="ID", help="Id of a fault, from trade faults: rosie-3f2a.")]

app = typer.Typer(
    cls=FirstByDefault,
    help="List, show and acknowledge faults of devices. Default: list.\n\nFor example: trade faults rosie --open",
)


@app.command("list")
def list_faults(
    context: typer.Context,
    robot: Annotated[str | None, typer.Argument(metavar="ROBOT", help="List only the faults of this robot.")] = None,
    open_only: Annotated[bool, typer.Option("--open", help="List only open faults.")] = False,
    as_json: Json = False,
) -> None:
    """List the faults of devices, the latest first.

    For example: trade faults rosie --open
    """
    out, silent = Output(as_json=as_json), False
    found: list[FaultInfo] = []
    with visitor_among_others(context) as container:
        for handle in _logs(container, robot):
            try:
                found += handle(open_only=open_only)
            except TradeError as error:
                silent = True
                complain(f"{handle.label}: {error}")
    found.sort(key=lambda info: -info.last_at)
    if as_json:
        out.data(found)
    elif not found:
        out.say("nothing is wrong" if open_only else "no faults are known")
    else:
        columns = ("ID", "DEVICE", "FAULT", "STATE", "COUNT", "FIRST", "LAST", "SEEN BY")
        out.table(columns, [_row(info) for info in found])
    if silent:
        raise typer.Exit(1)


@app.command()
def show(
    context: typer.Context,
    fault_id: Id,
    first: Annotated[bool, typer.Option("--first", help="Show the measurements of its first occurrence.")] = False,
    as_json: Json = False,
) -> None:
    """Show a fault, and what its device measured before it.

    For example: trade faults show rosie-3f2a
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        fault: Fault = _asked(container, fault_id, "fault")
    if as_json:
        out.data(fault)
        return
    remedy = as_commands(fault.device, fault.remedy)
    out.say(f"[bold]{escape(fault.text)}[/]" + (f"; {escape(remedy)}" if remedy else ""))
    out.say(f"{_state(fault)}; began {_times(fault)}, lasted {fault.lasted_s:.1f} s in all")
    if fault.acknowledged_at is not None:
        out.say(f"seen by {escape(fault.acknowledged_by)} at {day_and_clock(fault.acknowledged_at)}")
    for note in fault.evidence:
        out.say(f"evidence: {escape(note)}")
    samples = fault.first if first else fault.latest
    if samples:
        out.table(*_samples_table(samples[-_SHOWN:]))
    else:
        out.say("nothing was measured before it")


@app.command()
def ack(context: typer.Context, fault_id: Id, as_json: Json = False) -> None:
    """Acknowledge a fault. This clears nothing in the device and moves nothing.

    For example: trade faults ack rosie-3f2a
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        seen: FaultInfo = _asked(container, fault_id, "acknowledge")
    if as_json:
        out.data(seen)
    else:
        out.say(f"{escape(seen.device)}: {escape(_said(seen))}: seen by {escape(seen.acknowledged_by)}; {_state(seen)}")


def _logs(container: Container, robot: str | None) -> "Sequence[Handle]":
    wanted = asked_for(f"robot {robot!r}", name="faults", group=None if robot is None else f"{robot}.faults")
    found = container.services(wanted & where(kind="FaultLog"))
    if not found and robot is not None:
        found = [container.find(wanted, wait_s=_WAIT_S)]
    return found


def _asked(container: Container, fault_id: str, name: str) -> Any:
    """Calls a service of the log that has the fault; each process of a robot has a log."""
    robot = fault_id.rpartition("-")[0]
    if not robot:
        raise UsageError(where=fault_id, problem="is no id of a fault, such as rosie-3f2a; `trade faults` lists them")
    wanted = asked_for(f"id {fault_id!r}", name=name, group=f"{robot}.faults")
    *others, last = container.services(wanted) or [container.find(wanted, wait_s=_WAIT_S)]
    for log in others:
        with contextlib.suppress(InvalidArgument):  # another log has it
            return log(fault_id)
    return last(fault_id)


def _said(info: "FaultInfo") -> str:
    """Returns what `FaultInfo.summary` does in the driver's process; here only the fields are known."""
    begin = f"{info.device}: "
    return info.text.removeprefix(begin) if info.text.startswith(begin) else info.kind


def _row(info: "FaultInfo") -> tuple[str, ...]:
    return (
        info.id,
        info.device,
        _said(info),
        _state(info),
        str(info.count),
        day_and_clock(info.first_at),
        day_and_clock(info.last_at),
        info.acknowledged_by,
    )


def _state(info: "FaultInfo") -> str:
    return "open" if info.gone_at is None else "gone"


def _times(info: "FaultInfo") -> str:
    if info.count == 1:
        return f"once, {day_and_clock(info.first_at)}"
    return f"{info.count} times, first {day_and_clock(info.first_at)}, last {day_and_clock(info.last_at)}"


def _samples_table(samples: "Sequence[FaultSample]") -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    names = tuple(dict.fromkeys(name for sample in samples for name in sample.values))
    rows = [(f"{sample.s:+.2f}", *(_number(sample.values.get(name)) for name in names)) for sample in samples]
    return ("S", *names), rows


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
