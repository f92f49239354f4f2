"""``trade policy``: shows the rights in a policy file, without a running system."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from trade.policies import VERBS, Decision, Policy, decide_call, read_policy
from trade_gateway._usage import UsageError
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output

app = typer.Typer(
    no_args_is_help=True,
    help="Show the rights that an access policy gives.\n\nFor example: trade policy show --policy policy.toml",
)

File = Annotated[Path | None, typer.Option("--policy", envvar="TRADE_POLICY", help="Policy file.")]


@app.command("check")
def check(
    identity: Annotated[str, typer.Argument(help="Identity to check.")],
    verb: Annotated[str, typer.Argument(help=f"Verb: {', '.join(VERBS)}.")],
    what: Annotated[str, typer.Argument(help="Group or service: rosie.neck.move_to; _ is no group.")],
    policy: File = None,
    as_json: Json = False,
) -> None:
    """Check whether an identity has a right, and by which rule.

    The exit code is 1 if it is denied. A stop service needs no rule, only an identity that is not revoked.

    For example: trade policy check planner call rosie.neck.move_to
    """
    if verb not in VERBS:
        raise UsageError(where=verb, problem=f"is no verb; use {', '.join(VERBS)}")
    decision = _decision(_read(policy), identity, verb, what)
    out = Output(as_json=as_json)
    if as_json:
        out.data(decision._asdict())
    out.say(f"{'[green]allowed[/]' if decision.allowed else '[bold red]denied[/]'}: {escape(decision.rule)}")
    if not decision.allowed:
        raise typer.Exit(1)


def _decision(policy: Policy, identity: str, verb: str, what: str) -> Decision:
    group, _, function = what.partition(".")
    if group == "trade" and function and verb in {"call", "read"}:
        return decide_call(policy, identity, group, function, "actuate")[1]
    return policy.decide(identity, verb, what)


@app.command("show")
def show(policy: File = None, as_json: Json = False) -> None:
    """List the identities of a policy with their roles and rights.

    For example: trade policy show --policy policy.toml
    """
    read, out = _read(policy), Output(as_json=as_json)
    if as_json:
        identities = {name: {"roles": read.roles_of(name), **_groups(read, name)} for name in read.identities}
        out.data({"identities": identities, "revoked": sorted(read.revoked)})
        return
    rows = [
        (name, ", ".join(read.roles_of(name)), *(", ".join(groups) for groups in _groups(read, name).values()))
        for name in read.identities
    ]
    out.table(("IDENTITY", "ROLES", *(verb.upper() for verb in VERBS)), rows)
    if read.revoked:
        out.say(f"revoked: {escape(', '.join(sorted(read.revoked)))}")


def _groups(policy: Policy, identity: str) -> dict[str, list[str]]:
    return {verb: policy.groups_of(identity, (verb,)) for verb in VERBS}


def _read(path: Path | None) -> Policy:
    if path is None:
        raise UsageError(
            where="trade policy", problem="needs a policy: --policy FILE, or TRADE_POLICY in the environment"
        )
    return read_policy(path)
