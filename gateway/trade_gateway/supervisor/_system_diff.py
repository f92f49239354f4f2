"""Compares a system file with what runs, and writes a system file from what runs."""

import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from trade import Container, ContainerInfo, where
from trade.atomic_files import claim, fresh_beside
from trade.errors import ConfigurationError
from trade_gateway.config._gateway_file import read_gateway_file
from trade_gateway.supervisor._described import ChildTables, Difference, as_toml, described, differences, paths_in
from trade_gateway.supervisor._objects import GROUP
from trade_gateway.supervisor._system_file import SystemPlan, read_system_file


class Snapshot(NamedTuple):
    """A system file from what runs."""

    text: str
    containers: list[str]
    """The containers that it describes."""
    left_out: list[str]
    """The containers that it cannot describe, as text."""


def compared(plan: SystemPlan, member: Container) -> Iterator[Difference]:
    """Returns the differences between a system file and the system.

    A container with a supervisor is compared by its table, another one only by its presence.
    """
    known = {info.name for info in _others(member)}
    for part in plan.parts:
        if part.name in plan.supervised:
            continue
        if part.name not in known:
            yield Difference(container=part.name, file="is named", runs="does not run")
        elif part.entry.gateway and part.entry.is_local:
            file = Path(part.words[-1])
            yield from differences(described(file, read_gateway_file(file)).tables, _tables(member, part.name).tables)
    named = {part.name for part in plan.parts}
    for name in sorted(known - named - _supervised(member)):
        if any(GROUP not in handle.groups for handle in member.services(where(container=name))):
            yield Difference(container=name, file="is not named", runs="runs")


def snapshot(member: Container, supervisor: str | None) -> Snapshot:
    """Describes the containers that a supervisor of this host keeps up.

    Args:
        member: this command's container.
        supervisor: the supervisor's container; None: the only one of this host.

    Raises:
        ConfigurationError: there is none or more than one, a gateway file has to describe it, or a file is gone.
    """
    others = {info.name: info for info in _others(member)}
    chosen = _chosen(member, others, supervisor)
    runs = _tables(member, chosen)
    if not runs.system:
        problem = f"joins networks or has its own credentials, so {runs.file} describes it; copy that file"
        raise ConfigurationError(where=f"supervisor {chosen}", problem=problem)
    named = [("system", runs.system), *((f"container.{name}", table) for name, table in runs.tables.items())]
    gone = [f"{at}.{key}: {path}" for at, table in named for key, path in paths_in(table) if not path.exists()]
    if gone:
        problem = f"these files are gone, so nothing was written: {'; '.join(gone)}"
        raise ConfigurationError(where=f"supervisor {chosen}", problem=problem)
    described_here = {chosen, *runs.tables, *(one.get("announces", "") for one in runs.tables.values())}
    left_out = [
        f"{info.name}, process {info.pid} on {info.host}"
        for info in others.values()
        if info.name not in described_here
        and any(GROUP not in handle.groups for handle in member.services(where(container=info.name)))
    ]
    head = [f"# What {chosen} kept up on {socket.gethostname()}. `trade system up` starts it.\n"]
    head += [f"# Not described, since {chosen} does not supervise it: {one}\n" for one in left_out]
    return Snapshot("".join(head) + "\n" + as_toml(runs.system, runs.tables), list(runs.tables), left_out)


def write(path: Path, text: str, *, force: bool) -> None:
    """Writes a system file whole, once it was read without an error.

    Raises:
        ConfigurationError: the file exists, cannot be written, or would have an error.
    """
    fresh = fresh_beside(path)
    try:
        if path.exists() and not force:
            raise ConfigurationError(where=str(path), problem="exists already; choose another name, or use --force")
        claim(fresh, text.encode())
        read_system_file(fresh)
        fresh.replace(path)
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be written: {bad.strerror}") from None
    finally:
        fresh.unlink(missing_ok=True)


def _others(member: Container) -> list[ContainerInfo]:
    return [info for info in member.containers() if info.epoch != member.address.epoch]


def _chosen(member: Container, others: Mapping[str, ContainerInfo], wanted: str | None) -> str:
    found = {handle.key.address.container for handle in member.services(where(name="child_tables", group=GROUP))}
    here = sorted(name for name in found if others[name].host == socket.gethostname() and _tables(member, name).file)
    if wanted is not None and wanted not in here:
        problem = f"there is no supervisor of that name on this host; there is {', '.join(here) or 'none'}"
        raise ConfigurationError(where=f"--supervisor {wanted}", problem=problem)
    if wanted is None and len(here) != 1:
        problem = f"there are {', '.join(here)}; choose one with --supervisor" if here else "no supervisor runs here"
        raise ConfigurationError(where="trade system snapshot", problem=problem)
    return wanted or here[0]


def _tables(member: Container, supervisor: str) -> ChildTables:
    return member.find(where(name="child_tables", group=GROUP, container=supervisor), wait_s=5.0)()


def _supervised(member: Container) -> set[str]:
    """Returns the containers that any supervisor keeps up, also under the names that programs announce."""
    found: set[str] = set()
    for handle in member.services(where(name="children", group=GROUP)):
        container = handle.key.address.container
        found |= {child.name for child in member.handle(handle.key)()}
        found |= {table.get("announces", "") for table in _tables(member, container).tables.values()}
    return found
