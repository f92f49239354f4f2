"""``trade services`` and ``trade containers``: lists of services and containers."""

from collections.abc import Sequence
from textwrap import indent
from typing import Annotated, Any, Final

import typer
from rich.markup import escape

from trade import Constraint, Container, ContainerInfo, Handle, LoadInfo, where
from trade.pddl import domain_of
from trade.protocol.messages import PROTOCOL
from trade_gateway._usage import UsageError, asked_for
from trade_gateway.cli.services._states import State, say_state
from trade_gateway.clients._load_table import loads, loads_table
from trade_gateway.terminal import _completion as completion
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import NOT_FOUND, Output, complain
from trade_gateway.terminal._system_choice import visitor_among_others

HEALTHY: Final = "healthy"
_CONDITIONS: Final = "Conditions"
_STARTS: Final = "; [bold]trade up examples/rosie.toml --sim[/] starts one"


def services(
    context: typer.Context,
    group: Annotated[
        str | None,
        typer.Option(autocompletion=completion.groups, help="List only this group and those beneath it: rosie.head."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="List only this name; * and ? are wildcards.")] = None,
    needs: Annotated[
        str | None,
        typer.Option(
            metavar="PREDICATE", rich_help_panel=_CONDITIONS, help="List only what has this pre-condition: 'see(?x)'."
        ),
    ] = None,
    achieves: Annotated[
        str | None,
        typer.Option(
            metavar="PREDICATE",
            rich_help_panel=_CONDITIONS,
            help="List only what has this post-condition: 'holding(?x)'.",
        ),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Also list the middleware's own services.")] = False,
    doc: Annotated[bool, typer.Option("--doc", help="Show the documentation of each service.")] = False,
    pddl: Annotated[
        bool,
        typer.Option(
            "--pddl",
            rich_help_panel=_CONDITIONS,
            help="Print the conditions as a planning domain, in PDDL, for planners.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """List services with their arguments, containers and hosts.

    For example: trade services --group rosie.head --doc
    """
    given = {"--group": group, "--name": name, "--needs": needs, "--achieves": achieves}
    words = " ".join(f"{option} {text}" for option, text in given.items() if text is not None)
    constraint = asked_for(words or "services", group=group, name=name, needs=needs, achieves=achieves)
    if not everything and group is None:
        constraint = constraint & ~where(group="trade")
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        found = container.services(constraint)
        if pddl:
            _say_domain(found, group or "trade")
        elif as_json:
            out.data([describe(handle) for handle in found])
        elif not found:
            out.say(_nothing(container, constraint))
        elif doc:
            for handle in found:
                doc_text = "\n\n".join(filter(None, (handle.doc or "(undocumented)", handle.record.info.conditions)))
                out.say(
                    f"[bold]{escape(handle.label)}[/]  {escape(handle.signature)}\n{escape(indent(doc_text, '  '))}\n"
                )
        else:
            out.table(*_table(found))
    if not found and words:
        raise typer.Exit(NOT_FOUND)


def _say_domain(found: Sequence[Handle], name: str) -> None:
    domain = domain_of(found, name)
    for label, reason in domain.left_out.items():
        complain(f"left out {label}: {reason}")
    typer.echo(domain.text, nl=False)


def _nothing(container: Container, constraint: Constraint) -> str:
    """Reports that nothing matches, with the groups that exist."""
    others = container.services(~where(group="trade"))
    groups = sorted({group for handle in others for group in handle.groups})
    if groups:
        return f"no services match {escape(str(constraint))}; there is {', '.join(groups)}"
    if len(container.addresses()) > 1:
        return f"no services are visible from here in system {escape(container.settings.system)}"
    return f"nothing is up in system {escape(container.settings.system)}{_starts(container)}"


def _alone(container: Container) -> str:
    return f"no other container is up in this system{_starts(container)}"


def _starts(container: Container) -> str:
    """Suggests how to start a robot, unless the user has configured a system."""
    settings = container.settings
    return "" if settings.connect or settings.tls is not None else _STARTS


def describe(handle: Handle) -> dict[str, Any]:
    """Returns all fields of a handle as plain data."""
    return {
        "service": handle.label,
        "name": handle.name,
        "groups": handle.groups,
        "signature": handle.signature,
        "effect": handle.effect,
        "verb": handle.verb,
        "roles": handle.roles,
        "needs": handle.needs,
        "achieves": handle.achieves,
        "resources": handle.resources,
        "doc": handle.doc,
        "container": handle.container,
        "host": handle.host,
        "health": handle.health,
        "schema": handle.schema,
    }


def _table(found: Sequence[Handle]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Builds the table of services, with a health column if one is not healthy."""
    columns: dict[str, list[str]] = {"SERVICE": [handle.label for handle in found]}
    if any(handle.health != HEALTHY for handle in found):
        columns["HEALTH"] = [handle.health for handle in found]
    columns["CALLED AS"] = [handle.signature for handle in found]
    columns["EFFECT"] = [handle.effect for handle in found]
    columns["CONTAINER"] = [handle.container for handle in found]
    columns["HOST"] = [handle.host for handle in found]
    return tuple(columns), list(zip(*columns.values(), strict=True))


def containers(
    context: typer.Context,
    load: Annotated[bool, typer.Option("--load", help="Show how busy each container is, over 1 s.")] = False,
    show: Annotated[
        State | None,
        typer.Option(
            help="Show links, or network (endpoints, discovery, broadcast, end of the certificate), listeners (of "
            "streams) or events (the latest changes of these)."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the containers of the system, or one of their states.

    For example: trade containers --show links
    """
    if load and show is not None:
        raise UsageError(where="trade containers", problem="takes only one of --load and --show")
    out = Output(as_json=as_json)
    with visitor_among_others(context) as container:
        if load:
            _say_loads(out, container, loads(container))
            return
        if show is not None:
            say_state(out, container, show)
            return
        found = [info for info in container.containers() if info.epoch != container.address.epoch]
        if as_json:
            out.data(found)
        elif not found:
            out.say(_alone(container))
        else:
            out.table(*_containers_table(found))


def _containers_table(found: Sequence[ContainerInfo]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Builds the table of containers, with a protocol column if one has another version or has not answered."""
    columns: dict[str, list[str]] = {
        "CONTAINER": [info.name for info in found],
        "IDENTITY": [info.identity for info in found],
    }
    if any(info.protocol != PROTOCOL for info in found):
        columns["PROTOCOL"] = [_version(info) for info in found]
    columns["HOST"] = [info.host or "?" for info in found]
    columns["PID"] = [str(info.pid or "?") for info in found]
    columns["SERVICES"] = [str(info.services) if info.protocol == PROTOCOL else "?" for info in found]
    columns["EPOCH"] = [info.epoch for info in found]
    return tuple(columns), list(zip(*columns.values(), strict=True))


def _version(info: ContainerInfo) -> str:
    if info.protocol in (0, PROTOCOL):
        return str(info.protocol or "?")
    return f"{info.protocol} (here {PROTOCOL})"


def _say_loads(out: Output, container: Container, found: Sequence[LoadInfo]) -> None:
    if out.as_json:
        out.data(found)
    elif not found:
        out.say(_alone(container))
    else:
        out.table(*loads_table(found))
