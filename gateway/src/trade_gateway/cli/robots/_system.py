"""``trade system``: bring up what a system file describes, over its hosts; see how it fares; take it down."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from trade import Container
from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import choice_of
from trade_gateway.cli.robots._system_up import Bringing, Told, check_hosts
from trade_gateway.config._system import SystemPlan, read_system_file
from trade_gateway.process._signals import leaving

app = typer.Typer(no_args_is_help=True, help="A whole system from one file, over its hosts.")

File = Annotated[Path, typer.Argument(metavar="SYSTEM.toml", help="The system file.")]
SshConfig = Annotated[Path | None, typer.Option(help="Instead of ~/.ssh/config.")]


@app.command("up")
def up(
    context: typer.Context,
    file: File,
    check: Annotated[
        bool, typer.Option("--check", help="Only say whether the file is right, and its hosts in reach.")
    ] = False,
    keep: Annotated[bool, typer.Option("--keep", help="If one fails, leave those that were started.")] = False,
    wait: Annotated[
        float, typer.Option(min=0.1, max=600.0, help="Seconds until each must be seen here, and an object be made.")
    ] = 30.0,
    ssh_config: SshConfig = None,
    as_json: Json = False,
) -> None:
    """Start the containers of a file that are not up, in order; they stay up when this command ends.

    All is checked before anything is started. If one fails, those that were started are taken down again.

    For example: trade system up examples/system.toml --check
    """
    out, plan = Output(as_json=as_json), _plan(context, file)
    if check:
        check_hosts(plan, plan.parts, ssh_config)
        _say_order(out, plan)
        return
    with leaving() as interrupted, Container(plan.settings) as member:
        bringing = Bringing(plan, member, ssh_config=ssh_config, wait_s=wait, tell=_teller(out))
        bringing.up(keep=keep, interrupted=interrupted)
    out.say(f"[bold green]system {escape(plan.settings.system)} is up[/]; to end it: trade system down {file}")


@app.command("status")
def status(context: typer.Context, file: File, as_json: Json = False) -> None:
    """Say of each container of a file whether it is up. Exit code 0: all are; 1: something is missing.

    For example: trade system status examples/system.toml
    """
    out, plan = Output(as_json=as_json), _plan(context, file)
    with Container(plan.settings) as member:
        found = list(Bringing(plan, member, ssh_config=None, wait_s=0.0, tell=_teller(out)).status())
    if as_json:
        out.data(found)
    else:
        rows = [(told.container, told.state, told.host, str(told.pid or ""), str(told.services)) for told in found]
        out.table(("CONTAINER", "STATE", "HOST", "PID", "SERVICES"), rows)
    if any(told.state != "up" for told in found):
        raise typer.Exit(1)


@app.command("down")
def down(
    context: typer.Context,
    file: File,
    force: Annotated[
        bool, typer.Option("--force", help="End also what is locked or moves; it is brought to rest first.")
    ] = False,
    as_json: Json = False,
) -> None:
    """End the containers of a file, those first that were started last; stop at one that is locked or moves.

    For example: trade system down examples/system.toml
    """
    out, plan = Output(as_json=as_json), _plan(context, file)
    with Container(plan.settings) as member:
        bringing = Bringing(plan, member, ssh_config=None, wait_s=5.0, tell=_teller(out))
        bringing.down(only_at_rest=not force)


def _plan(context: typer.Context, file: Path) -> SystemPlan:
    plan, said = read_system_file(file), choice_of(context)
    if said.system not in (None, plan.settings.system) or said.connect:
        problem = f"{file} says which system it is, and whom to dial; leave out --system and --connect"
        raise UsageError(where="trade system", problem=problem)
    return plan


def _teller(out: Output) -> Callable[[Told], None]:
    def tell(told: Told) -> None:
        if out.as_json:
            out.data(told)
        where = f" on {told.host}" if told.host != "local" else ""
        process = f", process {told.pid}" if told.pid else ""
        took = f" after {told.took_s:.1f} s" if told.took_s >= 0.05 else ""
        out.say(f"{escape(told.container)}{escape(where)}: [bold]{escape(told.state)}[/]{took}{process}")

    return tell


def _say_order(out: Output, plan: SystemPlan) -> None:
    if out.as_json:
        order = [{"container": part.name, "host": part.entry.host, "kind": part.entry.kind} for part in plan.parts]
        out.data({"system": plan.settings.system, "order": order})
    out.say(f"{plan.path} is right; system {plan.settings.system}, in this order:")
    for part in plan.parts:
        where = "" if part.entry.is_local else f" on {part.entry.host}"
        out.say(f"  {escape(f'{part.name}{where}: {part.entry.kind}')}")
