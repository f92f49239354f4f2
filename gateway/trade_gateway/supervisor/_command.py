"""``trade system``: starts, shows and ends the containers of a system file, and compares the file with what runs."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import Container
from trade_gateway._usage import UsageError
from trade_gateway.process._signals import leaving
from trade_gateway.supervisor._system_diff import compared, snapshot, write
from trade_gateway.supervisor._system_file import SystemPlan, read_system_file
from trade_gateway.supervisor._system_up import Report, SystemStarter, check_hosts
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._system_choice import choice_of, visitor_among_others

SECTION: Final = sections.ROBOTS
PLACE: Final = 9
app = typer.Typer(
    no_args_is_help=True,
    help="Start, show and end the system of a file, on all its hosts.\n\n"
    "For example: trade system up examples/system.toml --check",
)

File = Annotated[Path, typer.Argument(metavar="SYSTEM.toml", help="The system file.")]
SshConfig = Annotated[Path | None, typer.Option(help="Configuration of ssh instead of ~/.ssh/config.")]


@app.command("up")
def up(
    context: typer.Context,
    file: File,
    check: Annotated[bool, typer.Option("--check", help="Check the file and its hosts, and exit.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="If one fails, keep those already started.")] = False,
    wait: Annotated[
        float,
        typer.Option(
            min=0.1, max=600.0, metavar="SECONDS", help="Time limit for each container and object, in seconds."
        ),
    ] = 30.0,
    ssh_config: SshConfig = None,
    as_json: Json = False,
) -> None:
    """Start the containers of a file that are not up, in order.

    The containers outlive this command. The file and its hosts are checked first.
    If a start fails, the containers started before are ended.

    For example: trade system up examples/system.toml --check
    """
    out, plan = Output(as_json=as_json), _plan(context, file)
    if check:
        check_hosts(plan, plan.parts, ssh_config)
        _say_order(out, plan)
        return
    with leaving() as interrupted, Container(plan.settings) as member:
        starter = SystemStarter(plan, member, ssh_config=ssh_config, wait_s=wait, report=_reporter(out))
        starter.up(keep=keep, interrupted=interrupted)
    out.say(f"[bold green]system {escape(plan.settings.system)} is up[/]; to end it: trade system down {file}")


@app.command("status")
def status(context: typer.Context, file: File, as_json: Json = False) -> None:
    """Show whether each container of a file is up.

    The exit code is 1 if one is missing or incomplete.

    For example: trade system status examples/system.toml
    """
    out, plan = Output(as_json=as_json), _plan(context, file)
    with Container(plan.settings) as member:
        found = list(SystemStarter(plan, member, ssh_config=None, wait_s=0.0, report=_reporter(out)).status())
    if as_json:
        out.data(found)
    else:
        rows = [(one.container, one.state, one.host, str(one.pid or ""), str(one.services)) for one in found]
        out.table(("CONTAINER", "STATE", "HOST", "PID", "SERVICES"), rows)
    if any(one.state != "up" for one in found):
        raise typer.Exit(1)


@app.command("down")
def down(
    context: typer.Context,
    file: File,
    force: Annotated[
        bool, typer.Option("--force", help="Also end containers that are locked or move; motion is stopped first.")
    ] = False,
    as_json: Json = False,
) -> None:
    """End the containers of a file in reverse order.

    The command ends with an error at the first container that is locked or moves.

    For example: trade system down examples/system.toml
    """
    out, plan = Output(as_json=as_json), _plan(context, file)
    with Container(plan.settings) as member:
        starter = SystemStarter(plan, member, ssh_config=None, wait_s=5.0, report=_reporter(out))
        starter.down(only_at_rest=not force)


@app.command("diff")
def diff(context: typer.Context, file: File, as_json: Json = False) -> None:
    """Show the differences between a file and what runs.

    The tables of supervised containers are compared key by key. The exit code is 1 if there is a difference.

    For example: trade system diff examples/system.toml
    """
    out, plan = Output(as_json=as_json), _plan(context, file)
    with Container(plan.settings) as member:
        found = list(compared(plan, member))
    if as_json:
        out.data(found)
    for one in found if not as_json else ():
        place = f"{one.container}.{one.key}" if one.key else one.container
        words = f"the file has {one.file}; what runs has {one.runs}" if one.key else f"{one.file}, and {one.runs}"
        out.say(escape(f"{place}: {words}"))
    if not found:
        out.say(f"{escape(str(file))} describes what runs")
    else:
        raise typer.Exit(1)


@app.command("snapshot")
def take_snapshot(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="OUT.toml", help="The system file to write.")],
    supervisor: Annotated[
        str | None, typer.Option(metavar="CONTAINER", help="Supervisor whose containers to describe.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Json = False,
) -> None:
    """Write a system file from what a supervisor of this host keeps up.

    Paths in it are absolute. Containers that no supervisor of this host started are named in a comment.
    If files that are needed for a start are gone, nothing is written. The file contains the variables of programs.

    For example: trade system snapshot now.toml
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as member:
        taken = snapshot(member, supervisor)
    write(file, taken.text, force=force)
    if as_json:
        out.data({"file": str(file), "containers": taken.containers, "left_out": taken.left_out})
    out.say(escape(f"wrote {file}: {', '.join(taken.containers)}"))
    for one in taken.left_out:
        complain(f"not in the file, since no supervisor of this host started it: {one}")


def _plan(context: typer.Context, file: Path) -> SystemPlan:
    plan, choice = read_system_file(file), choice_of(context)
    if choice.system not in (None, plan.settings.system) or choice.connect:
        problem = f"{file} names the system and its endpoints; leave out --system and --connect"
        raise UsageError(where="trade system", problem=problem)
    return plan


def _reporter(out: Output) -> Callable[[Report], None]:
    def report(one: Report) -> None:
        if out.as_json:
            out.data(one)
        where = f" on {one.host}" if one.host != "local" else ""
        process = f", process {one.pid}" if one.pid else ""
        took = f" after {one.took_s:.1f} s" if one.took_s >= 0.05 else ""
        out.say(f"{escape(one.container)}{escape(where)}: [bold]{escape(one.state)}[/]{took}{process}")

    return report


def _say_order(out: Output, plan: SystemPlan) -> None:
    if out.as_json:
        order = [{"container": part.name, "host": part.entry.host, "kind": part.entry.kind} for part in plan.parts]
        out.data({"system": plan.settings.system, "order": order})
    out.say(f"{plan.path} is right; system {plan.settings.system}, in this order:")
    for part in plan.parts:
        where = "" if part.entry.is_local else f" on {part.entry.host}"
        out.say(f"  {escape(f'{part.name}{where}: {part.entry.kind}')}")
