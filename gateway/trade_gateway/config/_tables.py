"""Reads the tables of containers in a file, in start order, with the command that starts each."""

import importlib.util
import os
import re
import shutil
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, Final, NoReturn, TypeVar, cast

import msgspec
from msgspec import Struct, structs

from trade import Settings
from trade.errors import ConfigurationError
from trade.policies import read_policy
from trade.rules import read_rules
from trade.toml_files import mismatch
from trade_drivers import check, load, without
from trade_drivers.plugins._ports import SeenPorts, check_ports
from trade_gateway.config._entry import (
    INSIDE,
    KINDS,
    LOCAL,
    ONLY_WITH,
    ContainerSpec,
    ContainerTable,
    FileDefaults,
)
from trade_gateway.config._kind import PRODUCTS, ContainerKind, kind_of_product
from trade_gateway.config._toml_file import at

_VARIABLE: Final = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_DEFAULTS: Final = ContainerTable()
_Read = TypeVar("_Read", bound=Struct)
_Entry = TypeVar("_Entry", bound=ContainerTable)


class Tables:
    """The tables ``[container.NAME]`` of one file, already of the right types.

    Args:
        path: the file.
        text: the file's text, to find line numbers.
        defaults: settings for all containers.
        entries: the tables by name.
    """

    def __init__(self, path: Path, text: str, defaults: FileDefaults, entries: Mapping[str, ContainerTable]) -> None:
        self.path = path
        self.defaults = defaults
        self._text = text
        self._entries = entries
        self._ports: SeenPorts = {}

    def parts(self) -> "list[ContainerSpec]":
        """Returns all containers, each after those that it waits for. Raises ConfigurationError."""
        return [self._part(name) for name in self._order()]

    def _order(self) -> list[str]:
        for name, entry in self._entries.items():
            for other in entry.after:
                if other not in self._entries:
                    self.refuse(name, "after", f"there is no container {other!r}; {_some(self._entries)}")
        try:
            return list(TopologicalSorter({name: entry.after for name, entry in self._entries.items()}).static_order())
        except CycleError as cycle:
            ring = cast("list[str]", cycle.args[1])[::-1]
            self.refuse(ring[0], "after", f"is a ring: {' after '.join(ring)}; leave one of them out")

    def _part(self, name: str) -> "ContainerSpec":
        """Returns how a container is started."""
        entry = self._entries[name]
        self.check_kind(name, entry)
        environment = {} if entry.gateway else self._environment_of(entry)
        health = self.program_path(entry.health.command[0]) if entry.health else ""
        part = ContainerSpec(name, entry, self._words(name, entry), environment, self.beside(entry.folder), health)
        with self.errors_in(name, entry):
            Settings.read(system=self.defaults.system, container=name, environment={})
        if entry.is_local:
            self.check_here(name, entry, environment)
        return part

    @contextmanager
    def errors_in(self, name: str, entry: ContainerTable, key: str = "") -> Generator[None]:
        """Reports errors inside as errors of a container's table."""
        try:
            yield
        except ConfigurationError as wrong:
            self.refuse(name, key or (entry.kind if entry.file else ""), str(wrong))

    def check_kind(self, name: str, entry: ContainerTable) -> None:
        """Raises ConfigurationError if keys exclude each other."""
        kinds = [kind for kind in KINDS if getattr(entry, kind) not in ("", None)]
        if len(kinds) != 1:
            found = f"there is {' and '.join(kinds)}" if kinds else "there is none"
            self.refuse(name, kinds[1] if kinds else "", f"takes one of {', '.join(KINDS)}; {found}")
        for key, goes_with in ONLY_WITH.items():
            if getattr(entry, key) != getattr(_DEFAULTS, key) and kinds[0] not in goes_with:
                self.refuse(name, key, f"goes with {' and '.join(goes_with)}; leave it out")
        if entry.is_local and entry.command != "trade":
            self.refuse(name, "command", "goes with another host; leave it out")
        if entry.program is not None:
            self._check_program(name, entry)

    def _check_program(self, name: str, entry: ContainerTable) -> None:
        if not entry.is_local:
            self.refuse(name, "host", "a program runs on the host of its supervisor; name it in the gateway file there")
        if entry.announces and entry.health is not None:
            self.refuse(name, "health", "goes without announces, which is a sign of life already; leave one out")
        if entry.health is not None and entry.health.within_s > entry.health.every_s:
            self.refuse(name, "health", "within_s is longer than every_s; checks would overlap")
        if unset := [key for key in entry.env if not _VARIABLE.fullmatch(key)]:
            self.refuse(name, "env", f"{unset[0]!r} is no name of a variable")

    def _check_program_here(self, name: str, entry: ContainerTable, environment: Mapping[str, str]) -> None:
        folder, path = self.beside(entry.folder), {**self.defaults.inherited, **environment}.get("PATH")
        if not folder.is_dir():
            self.refuse(name, "folder" if entry.folder else "program", f"there is no folder {folder}")
        for key, words in (("program", entry.program), ("health", entry.health and entry.health.command)):
            if words and shutil.which(found := self.program_path(words[0]), path=path) is None:
                problem = f"there is no program {found}" if "/" in found else f"there is no {found} in PATH"
                self.refuse(name, key, f"{problem} that this user may run")
        with self.errors_in(name, entry, "announces"):
            Settings.read(system=self.defaults.system, container=entry.announces or name, environment={})

    def program_path(self, named: str) -> str:
        """Returns a program as an absolute path, or its bare name if it is to be found in PATH."""
        return str(self.beside(named)) if "/" in named else named

    def check_here(self, name: str, entry: ContainerTable, environment: Mapping[str, str]) -> None:
        """Raises ConfigurationError if something that it needs on this host is missing or wrong."""
        self._check_installed(name, entry)
        product, value = _product_of(entry)
        if product is not None and (problem := product.problem(value, self.beside)):
            self.refuse(name, entry.kind, problem)
        if entry.program is not None:
            self._check_program_here(name, entry, environment)
        with self.errors_in(name, entry):
            if product is not None:
                product.check(value, self.beside)
            if entry.robot:
                robot = without(load(self.beside(entry.robot)), entry.without)[0]
                check(robot)
                if not entry.sim:
                    check_ports(robot, seen=self._ports)
            if entry.rules:
                read_rules(self.beside(entry.rules))
            if policy := environment.get("TRADE_POLICY"):
                read_policy(Path(policy))
            Settings.read(
                system=self.defaults.system,
                container=name,
                connect=self._connect(entry),
                environment={**self.defaults.inherited, **environment},
            )

    def _check_installed(self, name: str, entry: ContainerTable) -> None:
        if entry.sim and importlib.util.find_spec("trade_hil_sim") is None:
            self.refuse(name, "sim", "needs trade-hil-sim; pip install trade-hil-sim")
        product, value = _product_of(entry)
        for extra, library in () if product is None else product.extras(value):
            if importlib.util.find_spec(library) is None:
                self.refuse(name, entry.kind, f"needs the extra {extra}; pip install 'trade-gateway[{extra}]'")

    def _words(self, name: str, entry: ContainerTable) -> list[str]:
        if entry.program is not None:
            return [self.program_path(entry.program[0]), *entry.program[1:]]
        dialled = [] if entry.gateway else [word for one in self._connect(entry) for word in ("--connect", one)]
        file = self._path(entry, entry.file)
        allowed = [pattern for made in entry.providers or () for pattern in (made.class_,)] + entry.allow
        match entry.kind:
            case "robot":
                left_out = [word for part in entry.without for word in ("--without", part)]
                does = ["up", file, "--name", name, *(["--sim"] if entry.sim else []), *left_out]
            case "gateway":
                does = ["gateway", file]
            case "rules":
                does = ["rules", "run", file, "--name", name]
            case kind if kind in PRODUCTS:
                does = kind_of_product(kind).words(name, getattr(entry, kind), lambda named: self._path(entry, named))
            case _:
                patterns = [word for pattern in dict.fromkeys(allowed) for word in ("--allow", pattern)]
                does = ["container", "--name", name, *patterns]
        return ["--system", self.defaults.system, *dialled, *does]

    def _path(self, entry: ContainerTable, named: str) -> str:
        return str(self.beside(named)) if entry.is_local else named

    def _connect(self, entry: ContainerTable) -> Sequence[str]:
        return self.defaults.connect if entry.connect is None else entry.connect

    def _environment_of(self, entry: ContainerTable) -> dict[str, str]:
        defaults = self.defaults if entry.is_local else FileDefaults(system=self.defaults.system)
        named = self.environment(entry.tls or defaults.tls, entry.policy or defaults.policy, entry.host)
        if entry.listen:
            named["TRADE_LISTEN"] = ",".join(entry.listen)
        if entry.metrics:
            named["TRADE_METRICS"] = entry.metrics
        if audit := entry.audit or defaults.audit:
            named["TRADE_AUDIT"] = self._path(entry, audit)
        if entry.providers is not None and entry.is_local:
            known = os.environ.get("PYTHONPATH")
            named["PYTHONPATH"] = os.pathsep.join([str(self.beside(entry.folder)), *([known] if known else [])])
        if entry.program is not None:
            named["TRADE_SYSTEM"] = self.defaults.system
            if dialled := self._connect(entry):
                named["TRADE_CONNECT"] = ",".join(dialled)
            if entry.announces:
                named["TRADE_CONTAINER"] = entry.announces
        return {**defaults.environment, **named, **entry.env}

    def environment(self, tls: str, policy: str, host: str = LOCAL) -> dict[str, str]:
        """Returns the variables for a certificate and a policy, with paths on that host."""
        places = {"TRADE_TLS": tls, "TRADE_POLICY": policy}
        named = {name: place for name, place in places.items() if place}
        return {name: str(self.beside(place)) for name, place in named.items()} if host == LOCAL else named

    def beside(self, named: str) -> Path:
        """Returns the absolute path of a file that the file names."""
        return (self.path.parent / named).absolute()

    def refuse(self, name: str, key: str, problem: str) -> NoReturn:
        """Raises ConfigurationError about a container."""
        raise ConfigurationError(where=at(self.path, self._text, ("container", name), key), problem=problem) from None


def _product_of(entry: ContainerTable) -> tuple[ContainerKind | None, Any]:
    """Returns what a product knows of a container, with the value that is for it; None for other kinds."""
    kind = entry.kind
    return (kind_of_product(kind) if kind in PRODUCTS else None), getattr(entry, kind)


def read_entry(raw: object, type_: type[_Entry], path: Path, text: str, table: tuple[str, ...]) -> _Entry:
    """Converts the table of a container, with the tables in it that products know. Raises ConfigurationError."""
    entry = converted(raw, type_, path, text, table)
    checked: dict[str, Any] = {}
    for key in PRODUCTS:
        value, inner = getattr(entry, key), kind_of_product(key).table
        if inner is not None and value is not None:
            checked[key] = msgspec.to_builtins(converted(value, inner, path, text, table, key))
    return structs.replace(entry, **checked)


def converted(
    raw: object, type_: type[_Read], path: Path, text: str, table: tuple[str, ...], inside: str = ""
) -> _Read:
    """Converts a table, or the one inside it under a key, to its type. Raises ConfigurationError with the line."""
    try:
        return msgspec.convert(raw, type_)
    except msgspec.ValidationError as bad:
        found = mismatch(bad)
    key = inside or re.split(r"[.\[]", found.place, maxsplit=1)[0]
    fields = INSIDE.get(key, type_).__struct_encode_fields__
    problem = found.problem
    if found.unknown:
        key, problem = key or found.unknown, f"unknown key {found.unknown!r}; there is {', '.join(fields)}"
    elif found.missing:
        problem = f"{found.missing} is missing"
    raise ConfigurationError(where=at(path, text, table, key), problem=problem)


def _some(names: Mapping[str, object]) -> str:
    return f"there is {', '.join(names)}"
