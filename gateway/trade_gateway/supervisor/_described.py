"""Tables of containers as plain data with absolute paths: compared with what runs, and written as a file."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import msgspec
import tomlkit
from msgspec import Struct

from trade_gateway.config._entry import ContainerTable
from trade_gateway.config._gateway_file import Plan
from trade_gateway.config._kind import PRODUCTS, kind_of_product

_PATHS: Final = ("robot", "gateway", "rules", "ros", "tls", "policy", "audit", "folder")
_INNER_PATHS: Final = {key: kind_of_product(key).paths for key in PRODUCTS}
_COMMANDS: Final = (("program",), ("health", "command"))
_MADE: Final = ("audit", "record.folder")
"""Folders that are made when they are missing, or by the user before a start."""
_HIDDEN: Final = "env"
"""Its values may be secret, so that only the names of its variables are shown."""


class ChildTables(Struct, frozen=True):
    """What a gateway supervises, as its file says, with absolute paths."""

    file: str
    """The file that it read; empty if its containers are of no file."""
    system: dict[str, Any]
    """The table ``[system]`` of a system file for the same containers; empty if only a gateway file can describe it."""
    tables: dict[str, Any]
    """The tables ``[container.NAME]`` by name, without keys that have their default."""


class Difference(Struct, frozen=True, kw_only=True):
    """One difference between a file and what runs."""

    container: str
    key: str = ""
    """The key of its table; empty: the container as a whole."""
    file: str = ""
    """What the file says."""
    runs: str = ""
    """What runs."""


def absolute(entry: ContainerTable, beside: Path) -> dict[str, Any]:
    """Returns a table as plain data that means the same in a file of any other folder."""
    table = cast("dict[str, Any]", msgspec.to_builtins(entry))
    for key in _PATHS:
        if table.get(key):
            table[key] = str((beside / table[key]).absolute())
    for key, inner in _INNER_PATHS.items():
        for name in inner:
            if table.get(key, {}).get(name):
                table[key][name] = str((beside / table[key][name]).absolute())
    for where in _COMMANDS:
        words = _in(table, where)
        if words and "/" in words[0]:
            words[0] = str((beside / words[0]).absolute())
    if entry.program is not None or entry.providers is not None:
        table.setdefault("folder", str(beside.absolute()))
    return table


def described(path: Path, plan: Plan) -> ChildTables:
    """Returns what a gateway supervises after it has read a file."""
    beside, file = path.parent, plan.file
    named = {"tls": file.tls, "policy": file.policy, "audit": file.audit}
    places = {key: str((beside / place).absolute()) for key, place in named.items() if place}
    system: dict[str, Any] = {"name": file.system, "supervisor": file.name, **places}
    system |= {"connect": file.connect} if file.connect else {}
    other = file.network or file.share or file.credentials or file.insecure_lan or file.metrics or file.hub
    tables = {child.name: absolute(child.terms, beside) for child in plan.children}
    return ChildTables(str(path.absolute()), {} if other else system, tables)


def paths_in(table: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
    """Returns the files and folders that a table needs at its start, with their keys."""
    for key in _PATHS:
        if table.get(key) and key not in _MADE:
            yield key, Path(table[key])
    for key, inner in _INNER_PATHS.items():
        for name in inner:
            if table.get(key, {}).get(name) and f"{key}.{name}" not in _MADE:
                yield key, Path(table[key][name])
    for where in _COMMANDS:
        words = _in(table, where)
        if words and "/" in words[0]:
            yield where[0], Path(words[0])


def differences(file: Mapping[str, Any], runs: Mapping[str, Any]) -> Iterator[Difference]:
    """Compares the tables of a file with those of what runs."""
    for name in dict.fromkeys((*file, *runs)):
        if name not in runs:
            yield Difference(container=name, file="is named", runs="is not supervised")
        elif name not in file:
            yield Difference(container=name, file="is not named", runs="is supervised")
        else:
            wanted, known = file[name], runs[name]
            for key in dict.fromkeys((*wanted, *known)):
                if wanted.get(key) != known.get(key):
                    yield Difference(
                        container=name,
                        key=key,
                        file=_shown(key, wanted.get(key)),
                        runs=_shown(key, known.get(key)),
                    )


def as_toml(system: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns a system file."""
    return tomlkit.dumps({"system": system, "container": tables})


def _in(table: Mapping[str, Any], where: tuple[str, ...]) -> list[str]:
    found: Any = table
    for key in where:
        found = found.get(key) or {}
    return found or []


def _shown(key: str, value: Any) -> str:
    if value is None:
        return "the default"
    return f"other values of {', '.join(value)}" if key == _HIDDEN else json.dumps(value, ensure_ascii=False)
