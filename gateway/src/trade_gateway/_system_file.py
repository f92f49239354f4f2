"""The system file: which containers make up a system, on which hosts, in which order. Checked as a whole."""

import importlib.util
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, NoReturn, TypeVar, cast

import msgspec
from msgspec import Meta, Struct

from trade import Settings
from trade.errors import ConfigurationError
from trade.policies import read_policy
from trade.rules import read_rules
from trade_drivers import load
from trade_gateway._gateway_file import read_gateway_file

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

__all__ = ["LOCAL", "Entry", "Made", "Part", "SystemPlan", "line_of", "read_system_file"]

LOCAL: Final = "local"
_KINDS: Final = ("robot", "gateway", "providers", "rules")
_ONLY_WITH: Final = {"sim": "robot", "allow": "providers"}
_TELLS_ITSELF: Final = ("tls", "policy", "audit", "metrics", "connect", "listen")
"""What a gateway file says, and the system file does not."""
_HEADER: Final = re.compile(r"\s*\[\s*([^\[\]]+?)\s*\]\s*(?:#.*)?$")
_NAME: Final = re.compile(r"""["']([^"']*)["']|([\w-]+)""")
_AT: Final = re.compile(r" - at `\$\.?([^`]*)`$")
_UNKNOWN: Final = re.compile(r"contains unknown field `([^`]*)`")
_MISSING: Final = re.compile(r"missing required field `([^`]*)`")

_Text = Annotated[str, Meta(min_length=1)]
_Read = TypeVar("_Read", bound=Struct)


class Made(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"class_": "class"}):
    """An object that is made in a container, and offered."""

    class_: Annotated[str, Meta(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_][\w.]*$")]
    """Such as ``mypkg.vision:Camera``."""
    groups: list[_Text] = []
    args: list[Any] | dict[str, Any] = []
    """For its constructor, in order or by name."""


class Entry(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One container. Files are beside the system file; those of another host are as that host sees them."""

    host: _Text = LOCAL
    """``local``, or as for ssh: HOST or USER@HOST."""
    robot: str = ""
    """A robot file."""
    sim: bool = False
    """Simulate the robot's devices."""
    gateway: str = ""
    """A gateway file."""
    providers: list[Made] | None = None
    """What is made in it; modules of this host may be beside the system file."""
    allow: list[_Text] = []
    """Classes that others may make in it, besides these."""
    rules: str = ""
    """A rules file."""
    after: list[_Text] = []
    """Containers that must be up before."""
    tls: str = ""
    policy: str = ""
    audit: str = ""
    """Folder for the record of what happens in it."""
    metrics: str = ""
    """Where Prometheus finds its metrics: ``127.0.0.1:9464``."""
    connect: list[_Text] | None = None
    """Endpoints it dials; none: those of the system."""
    listen: list[_Text] = []
    command: _Text = "trade"
    """Of another host: the path of ``trade`` there."""

    @property
    def kind(self) -> str:
        """The key that says what it is; the file is checked to have one."""
        return next(kind for kind in _KINDS if getattr(self, kind) not in ("", None))

    @property
    def file(self) -> str:
        """The file of a robot, a gateway or rules."""
        return self.robot or self.gateway or self.rules

    @property
    def is_local(self) -> bool:
        """Whether it runs on the host of whoever brings the system up."""
        return self.host == LOCAL


class _System(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: _Text
    """The system id."""
    tls: str = ""
    """Of `trade system` itself, and of containers of this host that name none."""
    policy: str = ""
    audit: str = ""
    """Of containers of this host that name none."""
    connect: list[_Text] = []


class Part(NamedTuple):
    """A container, and how it is started."""

    name: str
    entry: Entry
    words: Sequence[str]
    """After ``trade``."""
    environment: Mapping[str, str]
    """Besides what is set anyway."""

    @property
    def files(self) -> list[str]:
        """What its host has to have."""
        named = [self.environment[name] for name in ("TRADE_TLS", "TRADE_POLICY") if name in self.environment]
        return [*([self.entry.file] if self.entry.file else []), *named]


class SystemPlan(NamedTuple):
    """A system file with all that it names on this host, checked."""

    path: Path
    settings: Settings
    """Of who brings it up."""
    parts: Sequence[Part]
    """In the order in which they are started."""
    text: str

    def at(self, name: str, key: str = "") -> str:
        """Where the file speaks of a container, for errors."""
        return _at(self.path, self.text, ("container", name), key)


def read_system_file(path: Path) -> SystemPlan:
    """Read and check a system file, and the files of this host that it names. Nothing is started and nobody is asked.

    Raises:
        ConfigurationError: names the file, the line, the key and what would be right.
    """
    text, raw = _read(path)
    for key in raw:
        if key not in ("system", "container"):
            problem = "unknown; there is [system] and [container.NAME]"
            raise ConfigurationError(where=f"{path}:{line_of(text, (key,), key)}: {key}", problem=problem)
    if not isinstance(raw.get("system"), dict):
        raise ConfigurationError(where=f"{path}:1: system", problem='missing; write [system] and name = "lab"')
    system = _converted(raw["system"], _System, path, text, ("system",))
    tables = raw.get("container")
    if not isinstance(tables, dict) or not tables:
        raise ConfigurationError(where=f"{path}:1: container", problem="missing; write [container.NAME]")
    entries = {
        name: _converted(table, Entry, path, text, ("container", name))
        for name, table in cast("dict[str, object]", tables).items()
    }
    reading = _Reading(path, text, system, entries)
    settings = reading.own_settings()
    return SystemPlan(path, settings, [reading.part(name) for name in reading.order()], text)


class _Reading:
    """What is to be checked of a file once its shape is right."""

    def __init__(self, path: Path, text: str, system: _System, entries: Mapping[str, Entry]) -> None:
        self._path = path
        self._text = text
        self._system = system
        self._entries = entries

    def own_settings(self) -> Settings:
        """Of who brings the system up."""
        environment = {**os.environ, **self._environment(self._system.tls, self._system.policy, (), LOCAL)}
        try:
            if self._system.policy:
                read_policy(self._beside(self._system.policy))
            settings = Settings.read(system=self._system.name, connect=self._system.connect, environment=environment)
            return replace(settings, audit=None, metrics="")  # it comes and goes
        except ConfigurationError as wrong:
            self._refuse(("system",), "", str(wrong))

    def order(self) -> list[str]:
        """The containers, each behind those that it has to wait for."""
        for name, entry in self._entries.items():
            for other in entry.after:
                if other not in self._entries:
                    self._refuse_part(name, "after", f"there is no container {other!r}; {_some(self._entries)}")
        try:
            return list(TopologicalSorter({name: entry.after for name, entry in self._entries.items()}).static_order())
        except CycleError as cycle:
            ring = cast("list[str]", cycle.args[1])[::-1]
            self._refuse_part(ring[0], "after", f"is a ring: {' after '.join(ring)}; leave one of them out")

    def part(self, name: str) -> Part:
        """How a container is started."""
        entry = self._entries[name]
        self._check_kind(name, entry)
        environment = {} if entry.gateway else self._environment_of(entry)
        part = Part(name, entry, self._words(name, entry), environment)
        try:
            Settings.read(system=self._system.name, container=name, environment={})
            if entry.is_local:
                self._check_here(name, entry, environment)
        except ConfigurationError as wrong:
            self._refuse_part(name, entry.kind if entry.file else "", str(wrong))
        return part

    def _check_kind(self, name: str, entry: Entry) -> None:
        kinds = [kind for kind in _KINDS if getattr(entry, kind) not in ("", None)]
        if len(kinds) != 1:
            found = f"there is {' and '.join(kinds)}" if kinds else "there is none"
            self._refuse_part(name, kinds[1] if kinds else "", f"takes one of {', '.join(_KINDS)}; {found}")
        for key, kind in _ONLY_WITH.items():
            if getattr(entry, key) and kind not in kinds:
                self._refuse_part(name, key, f"goes with {kind}; leave it out")
        for key in _TELLS_ITSELF if entry.gateway else ():
            if getattr(entry, key):
                self._refuse_part(name, key, "is said by the gateway file; leave it out")
        if entry.is_local and entry.command != "trade":
            self._refuse_part(name, "command", "goes with another host; leave it out")

    def _check_here(self, name: str, entry: Entry, environment: Mapping[str, str]) -> None:
        """Raises ConfigurationError if what it needs of this host is not there, or is wrong."""
        file = self._beside(entry.file)
        if entry.robot:
            load(file)
        if entry.sim and importlib.util.find_spec("trade_hil_sim") is None:
            self._refuse_part(name, "sim", "needs trade-hil-sim; pip install trade-hil-sim")
        if entry.rules:
            read_rules(file)
        if entry.gateway:
            settings = read_gateway_file(file).settings
            for key, said, wanted in (
                ("name", settings.container, name),
                ("system", settings.system, self._system.name),
            ):
                if said != wanted:
                    self._refuse_part(name, "gateway", f"{file} has {key} = {said!r}; here it is {wanted!r}")
            return
        if policy := environment.get("TRADE_POLICY"):
            read_policy(Path(policy))
        Settings.read(
            system=self._system.name,
            container=name,
            connect=self._connect(entry),
            environment={**os.environ, **environment},
        )

    def _words(self, name: str, entry: Entry) -> list[str]:
        dialled = [] if entry.gateway else [word for one in self._connect(entry) for word in ("--connect", one)]
        file = str(self._beside(entry.file)) if entry.is_local else entry.file
        allowed = [pattern for made in entry.providers or () for pattern in (made.class_,)] + entry.allow
        match entry.kind:
            case "robot":
                does = ["up", file, "--name", name, *(["--sim"] if entry.sim else [])]
            case "gateway":
                does = ["gateway", file]
            case "rules":
                does = ["rules", "run", file, "--name", name]
            case _:
                patterns = [word for pattern in dict.fromkeys(allowed) for word in ("--allow", pattern)]
                does = ["container", "--name", name, *patterns]
        return ["--system", self._system.name, *dialled, *does]

    def _connect(self, entry: Entry) -> Sequence[str]:
        return self._system.connect if entry.connect is None else entry.connect

    def _environment_of(self, entry: Entry) -> dict[str, str]:
        system = self._system if entry.is_local else _System(name=self._system.name)
        named = self._environment(entry.tls or system.tls, entry.policy or system.policy, entry.listen, entry.host)
        if entry.metrics:
            named["TRADE_METRICS"] = entry.metrics
        if audit := entry.audit or system.audit:
            named["TRADE_AUDIT"] = str(self._beside(audit)) if entry.is_local else audit
        if entry.providers is not None and entry.is_local:
            known = os.environ.get("PYTHONPATH")
            named["PYTHONPATH"] = os.pathsep.join([str(self._path.parent.absolute()), *([known] if known else [])])
        return named

    def _environment(self, tls: str, policy: str, listen: Sequence[str], host: str) -> dict[str, str]:
        places = {"TRADE_TLS": tls, "TRADE_POLICY": policy}
        named = {name: place for name, place in places.items() if place}
        if host == LOCAL:
            named = {name: str(self._beside(place)) for name, place in named.items()}
        return {**named, "TRADE_LISTEN": ",".join(listen)} if listen else named

    def _beside(self, named: str) -> Path:
        return (self._path.parent / named).absolute()

    def _refuse_part(self, name: str, key: str, problem: str) -> NoReturn:
        self._refuse(("container", name), key, problem)

    def _refuse(self, table: tuple[str, ...], key: str, problem: str) -> NoReturn:
        raise ConfigurationError(where=_at(self._path, self._text, table, key), problem=problem) from None


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8")
        return text, cast("dict[str, Any]", tomllib.loads(text))  # pyright: ignore[reportUnknownMemberType]
    except FileNotFoundError:
        raise ConfigurationError(where=str(path), problem="there is no such file") from None
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror}") from None
    except ValueError as bad:  # tomllib.TOMLDecodeError is one, and so is text that is no UTF-8
        raise ConfigurationError(where=str(path), problem=f"not valid TOML: {bad}") from None


def _converted(raw: object, kind: type[_Read], path: Path, text: str, table: tuple[str, ...]) -> _Read:
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as bad:
        said = str(bad)
    at = _AT.search(said)
    inside = at.group(1) if at else ""
    key, fields = re.split(r"[.\[]", inside, maxsplit=1)[0], (Made if inside else kind).__struct_encode_fields__
    problem = said[: at.start()] if at else said
    if unknown := _UNKNOWN.search(said):
        key, problem = key or unknown.group(1), f"unknown key {unknown.group(1)!r}; there is {', '.join(fields)}"
    elif missing := _MISSING.search(said):
        problem = f"{missing.group(1)} is missing"
    raise ConfigurationError(where=_at(path, text, table, key), problem=problem)


def _at(path: Path, text: str, table: tuple[str, ...], key: str) -> str:
    return f"{path}:{line_of(text, table, key)}: {'.'.join((*table, key) if key else table)}"


def line_of(text: str, table: Sequence[str], key: str = "") -> int:
    """The line of a key in a table of a TOML text; else that of the table's header; 1 if that is not found either."""
    inside, at = False, 1
    wanted = re.compile(rf"""\s*["']?{re.escape(key)}["']?\s*=""")
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            names = [quoted or bare for quoted, bare in _NAME.findall(header.group(1))]
            inside = names[: len(table)] == list(table)
            at = number if inside and at == 1 else at
        elif inside and key and wanted.match(line):
            return number
    return at


def _some(names: Mapping[str, object]) -> str:
    return f"there is {', '.join(names)}"
