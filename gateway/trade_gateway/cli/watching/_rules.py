"""``trade rules``: runs, tests and lists rules, by which a system configures itself."""

import queue
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import Container, where
from trade.errors import TradeError
from trade.rules import GROUP, DryRun, Firing, RuleInfo, Rules, StepResult, read_rules, rehearse
from trade.timestamps import clock
from trade_gateway.cli.watching.rule_file import RuleFile
from trade_gateway.process._signals import hangups, leaving, refuse_twice
from trade_gateway.terminal._detached import Detach, detach_now, ready
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._system_choice import choice_of, visitor_among_others

_LOOK_EVERY_S: Final = 0.5

app = typer.Typer(
    no_args_is_help=True,
    help="Run, test and list the rules by which the system configures itself.\n\n"
    "For example: trade rules test examples/rules.toml",
)

File = Annotated[Path, typer.Argument(metavar="RULES.toml", help="The rules file.")]


@app.command("run")
def run(
    context: typer.Context,
    file: File,
    audit: Annotated[Path | None, typer.Option(help="File to write a line of JSON to for every firing.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what each rule would call, and call nothing.")
    ] = False,
    name: Annotated[str, typer.Option(help="Name of the container; the rules have its rights.")] = ("rules"),
    detach: Detach = False,
    as_json: Json = False,
) -> None:
    """Run the rules of a file until Ctrl-C or SIGTERM; print every firing.

    The file is read again when it changes, and on SIGHUP.
    If the new file has an error, it is reported and the rules continue as before.

    For example: trade rules run examples/rules.toml --audit rules.jsonl
    """
    out, firings, settings = Output(as_json=as_json), queue.SimpleQueue[Firing](), choice_of(context).settings(name)
    if detach:
        detach_now(out, settings)
        return
    with (
        leaving() as asked_to_leave,
        hangups() as hangup,
        Container(settings, on_terminate=asked_to_leave.set) as container,
        Rules(container, file, audit=audit, dry_run=dry_run, callback=firings.put) as rules,
    ):
        container.register_functions(RuleFile(container, file), "rule_file")
        refuse_twice(container, "trade rules run")
        seen = _contents(file)
        _say_ready(out, container, rules)
        while not asked_to_leave.wait(_LOOK_EVERY_S):
            _say_firings(out, firings)
            now = _contents(file)
            if now != seen or hangup.is_set():
                seen = now
                hangup.clear()
                _reload(out, rules, file)
    _say_firings(out, firings)
    out.say("leaving")


def _contents(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:  # the reload reports the error
        return None


def _say_ready(out: Output, container: Container, rules: Rules) -> None:
    names = [info.name for info in rules.rules()]
    if out.as_json:
        out.data({**ready(container), "rules": names})
    out.say(f"[bold green]{container.name} is up[/] as {escape(container.address.identity)}: {', '.join(names)}")
    out.say("Ctrl-C leaves; the file is read again when it changes")


def _say_firings(out: Output, firings: "queue.SimpleQueue[Firing]") -> None:
    while not firings.empty():
        firing = firings.get()
        if out.as_json:
            out.data(firing)
            continue
        at = clock(firing.at)
        about = f" ({firing.service})" if firing.service else ""
        out.say(f"{at} [bold]{firing.rule}[/]: {escape(f'{firing.occasion}{about}')}")
        for did in firing.steps:
            _say_step(out, did)
        if firing.stopped:
            out.say(f"  [bold red]stopped until the file is read again: {escape(firing.stopped)}[/]")


def _say_step(out: Output, did: StepResult) -> None:
    to = f": {did.service} in {did.container}" if did.service else ""
    end = f"[bold red]{escape(did.error)}[/]" if did.error else escape(did.result)
    out.say(f"  {escape(f'{did.step}{to}')}: {end}")


def _reload(out: Output, rules: Rules, file: Path) -> None:
    try:
        rules.load(file)
    except TradeError as wrong:
        complain(f"{file} was changed and has an error; continuing as before: {wrong}")
        return
    out.say(f"read {escape(str(file))} again")
    if out.as_json:
        out.data({"reloaded": str(file)})


@app.command("test")
def test(context: typer.Context, file: File, as_json: Json = False) -> None:
    """Check a rules file, and show what each rule would call now.

    Only the services of conditions are called, with your own rights.

    For example: trade rules test examples/rules.toml
    """
    out, rules = Output(as_json=as_json), read_rules(file)
    with visitor_among_others(context) as container:
        rehearsals = rehearse(container, rules)
    if as_json:
        out.data(rehearsals)
    for rehearsal in rehearsals:
        _say_rehearsal(out, rehearsal)


def _say_rehearsal(out: Output, tried: DryRun) -> None:
    fires = "[bold]would fire now[/]" if tried.fires else "would not fire now"
    occasion = f"{tried.occasion}, {tried.condition}" if tried.condition else tried.occasion
    now = f" ({tried.now})" if tried.now else ""
    out.say(f"[bold]{tried.rule}[/]: {escape(occasion)}: {fires}{escape(now)}")
    for did in tried.steps:
        _say_step(out, did)


@app.command("list")
def list_(context: typer.Context, as_json: Json = False) -> None:
    """List the rules that run in the system, with their state and counts.

    For example: trade rules list --json
    """
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        outcomes = container.call_all(where(name="rules", group=GROUP, kind="Rules"))
    found: list[RuleInfo] = []
    for outcome in outcomes:
        if outcome.ok:
            found += outcome.result
        else:
            complain(f"{outcome.handle.container} did not answer: {outcome.error}")
    if as_json:
        out.data(found)
    elif not found:
        out.say("no rules run; [bold]trade rules run examples/rules.toml[/] starts some")
    else:
        columns = (
            "RULE",
            "OCCASION",
            "CONDITION",
            "STATE",
            "FIRED",
            "FAILED",
            "SKIPPED",
            "CONTAINER",
            "WHY",
            "LAST ERROR",
        )
        out.table(columns, [_row(info) for info in found])


def _row(info: RuleInfo) -> tuple[str, ...]:
    return (
        info.name,
        info.occasion,
        info.condition,
        f"{info.state}, dry run" if info.dry_run else info.state,
        str(info.fired),
        str(info.failed),
        str(info.skipped),
        info.container,
        info.why,
        info.last_error,
    )
