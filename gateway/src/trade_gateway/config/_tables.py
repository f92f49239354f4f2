"""Reads the tables of containers in a file, in start order, with the command that starts each."""

import importlib.util
import os
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, NoReturn, TypeVar, cast

import msgspec
from msgspec import Meta, Struct

from trade import Settings
from trade._toml import read_toml_text
from trade.errors import ConfigurationError
from trade.policies import read_policy
from trade.rules import read_rules
from trade_drivers import check, load, without

__all__ = [
    "LOCAL",
    "Around",
    "ContainerSpec",
    "Entry",
    "ObjectSpec",
    "Tables",
    "at",
    "converted",
    "line_of",
    "read_toml",
]

LOCAL: Final = "local"
_KINDS: Final = ("robot", "gateway", "providers", "rules", "http")
_ONLY_WITH: Final = {"sim": "robot", "without": "robot", "allow": "providers"}
_HEADER: Final = re.compile(r"\s*\[\s*([^\[\]]+?)\s*\]\s*(?:#.*)?$")
_NAME: Final = re.compile(r"""["']([^"']*)["']|([\w-]+)""")
_AT: Final = re.compile(r" - at `\$\.?([^`]*)`$")
_UNKNOWN: Final = re.compile(r"contains unknown field `([^`]*)`")
_MISSING: Final = re.compile(r"missing required field `([^`]*)`")

_Text = Annotated[str, Meta(min_length=1)]
_Read = TypeVar("_Read", bound=Struct)


class ObjectSpec(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"class_": "class"}):
    """An object to create in a container and offer as services."""

    class_: Annotated[str, Meta(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_][\w.]*$")]
    """The class, such as ``mypkg.vision:Camera``."""
    groups: list[_Text] = []
    args: list[Any] | dict[str, Any] = []
    """Arguments of its constructor, by position or by name."""


class HttpSpec(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An HTTP gateway: the options of ``trade http``."""

    listen: _Text = "127.0.0.1:7080"
    tokens: str = ""
    """The file of tokens: ``trade http token NAME --tokens FILE``."""
    tls: str = ""
    """Folder of the server's certificate."""
    origins: list[_Text] = []
    """Allowed origins of web pages."""
    hosts: list[_Text] = []
    """Further host names of the server."""


class Entry(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One container. Paths are relative to the system file; those of another host are paths there."""

    host: _Text = LOCAL
    """``local``, or as for ssh: HOST or USER@HOST."""
    robot: str = ""
    """A robot file."""
    sim: bool = False
    """Simulate the robot's devices."""
    without: list[_Text] = []
    """Buses, cameras and sensors of the robot to leave out."""
    gateway: str = ""
    """A gateway file."""
    providers: list[ObjectSpec] | None = None
    """Objects to create in it; modules of this host may be beside the system file."""
    allow: list[_Text] = []
    """Further classes that others may create in it."""
    rules: str = ""
    """A rules file."""
    http: HttpSpec | None = None
    after: list[_Text] = []
    """Containers that must be up first."""
    tls: str = ""
    policy: str = ""
    audit: str = ""
    """Folder of its audit record."""
    metrics: str = ""
    """Where Prometheus finds its metrics: ``127.0.0.1:9464``."""
    connect: list[_Text] | None = None
    """Endpoints that it connects to; None: those of the system."""
    listen: list[_Text] = []
    command: _Text = "trade"
    """The path of ``trade`` on another host."""

    @property
    def kind(self) -> str:
        """The key that sets its kind; a checked file has exactly one."""
        return next(kind for kind in _KINDS if getattr(self, kind) not in ("", None))

    @property
    def file(self) -> str:
        """The file of a robot, a gateway or rules."""
        return self.robot or self.gateway or self.rules

    @property
    def is_local(self) -> bool:
        """Whether it runs on the host of `trade system`."""
        return self.host == LOCAL


_INSIDE: Final[Mapping[str, type[Struct]]] = {"providers": ObjectSpec, "http": HttpSpec}
"""The type of the table under a key of an entry."""


class Around(Struct, frozen=True, kw_only=True):
    """Settings for all containers of a file."""

    system: str
    """The system id."""
    tls: str = ""
    """The default folder of certificates for containers of this host. ``policy`` and ``audit`` are defaults, too."""
    policy: str = ""
    audit: str = ""
    connect: Sequence[str] = ()
    environment: Mapping[str, str] = {}
    """Further variables of containers of this host, besides inherited ones."""
    inherited: Mapping[str, str] = os.environ


class ContainerSpec(NamedTuple):
    """A container, with the command that starts it."""

    name: str
    entry: Entry
    words: Sequence[str]
    """The words after ``trade``."""
    environment: Mapping[str, str]
    """Variables besides those that are set anyway."""

    @property
    def files(self) -> list[str]:
        """The files that its host must have."""
        named = [self.environment[name] for name in ("TRADE_TLS", "TRADE_POLICY") if name in self.environment]
        return [*([self.entry.file] if self.entry.file else []), *named]


class Tables:
    """The tables ``[container.NAME]`` of one file, already of the right types.

    Args:
        path: the file.
        text: the file's text, to find line numbers.
        around: settings for all containers.
        entries: the tables by name.
    """

    def __init__(self, path: Path, text: str, around: Around, entries: Mapping[str, Entry]) -> None:
        self.path = path
        self.around = around
        self._text = text
        self._entries = entries

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
        part = ContainerSpec(name, entry, self._words(name, entry), environment)
        with self.about(name, entry):
            Settings.read(system=self.around.system, container=name, environment={})
        if entry.is_local:
            self.check_here(name, entry, environment)
        return part

    @contextmanager
    def about(self, name: str, entry: Entry) -> Generator[None]:
        """Reports errors inside as errors of a container's table."""
        try:
            yield
        except ConfigurationError as wrong:
            self.refuse(name, entry.kind if entry.file else "", str(wrong))

    def check_kind(self, name: str, entry: Entry) -> None:
        """Raises ConfigurationError if keys exclude each other."""
        kinds = [kind for kind in _KINDS if getattr(entry, kind) not in ("", None)]
        if len(kinds) != 1:
            found = f"there is {' and '.join(kinds)}" if kinds else "there is none"
            self.refuse(name, kinds[1] if kinds else "", f"takes one of {', '.join(_KINDS)}; {found}")
        for key, kind in _ONLY_WITH.items():
            if getattr(entry, key) and kind not in kinds:
                self.refuse(name, key, f"goes with {kind}; leave it out")
        if entry.is_local and entry.command != "trade":
            self.refuse(name, "command", "goes with another host; leave it out")

    def check_here(self, name: str, entry: Entry, environment: Mapping[str, str]) -> None:
        """Raises ConfigurationError if something that it needs on this host is missing or wrong."""
        if entry.sim and importlib.util.find_spec("trade_hil_sim") is None:
            self.refuse(name, "sim", "needs trade-hil-sim; pip install trade-hil-sim")
        if entry.http and importlib.util.find_spec("uvicorn") is None:
            self.refuse(name, "http", "needs the extra http; pip install 'trade-gateway[http]'")
        if entry.http and not (entry.http.tokens or entry.http.tls):
            self.refuse(name, "http", "no client could log in; name tokens, or tls and its authority's certificates")
        if entry.http and entry.http.tokens and not (tokens := self.beside(entry.http.tokens)).exists():
            self.refuse(name, "http", f"there is no {tokens}; make it: trade http token NAME --tokens {tokens}")
        with self.about(name, entry):
            if entry.robot:
                check(without(load(self.beside(entry.robot)), entry.without)[0])
            if entry.rules:
                read_rules(self.beside(entry.rules))
            if policy := environment.get("TRADE_POLICY"):
                read_policy(Path(policy))
            Settings.read(
                system=self.around.system,
                container=name,
                connect=self._connect(entry),
                environment={**self.around.inherited, **environment},
            )

    def _words(self, name: str, entry: Entry) -> list[str]:
        dialled = [] if entry.gateway else [word for one in self._connect(entry) for word in ("--connect", one)]
        file = str(self.beside(entry.file)) if entry.is_local else entry.file
        allowed = [pattern for made in entry.providers or () for pattern in (made.class_,)] + entry.allow
        match entry.kind:
            case "robot":
                left_out = [word for part in entry.without for word in ("--without", part)]
                does = ["up", file, "--name", name, *(["--sim"] if entry.sim else []), *left_out]
            case "gateway":
                does = ["gateway", file]
            case "rules":
                does = ["rules", "run", file, "--name", name]
            case "http":
                does = ["http", "--name", name, *self._http_words(entry)]
            case _:
                patterns = [word for pattern in dict.fromkeys(allowed) for word in ("--allow", pattern)]
                does = ["container", "--name", name, *patterns]
        return ["--system", self.around.system, *dialled, *does]

    def _http_words(self, entry: Entry) -> list[str]:
        said = entry.http or HttpSpec()
        options = {"--listen": [said.listen], "--origin": said.origins, "--host": said.hosts}
        for option, named in (("--tokens", said.tokens), ("--tls", said.tls)):
            options[option] = [str(self.beside(named)) if entry.is_local else named] if named else []
        return [word for option, values in options.items() for value in values for word in (option, value)]

    def _connect(self, entry: Entry) -> Sequence[str]:
        return self.around.connect if entry.connect is None else entry.connect

    def _environment_of(self, entry: Entry) -> dict[str, str]:
        around = self.around if entry.is_local else Around(system=self.around.system)
        named = self.environment(entry.tls or around.tls, entry.policy or around.policy, entry.host)
        if entry.listen:
            named["TRADE_LISTEN"] = ",".join(entry.listen)
        if entry.metrics:
            named["TRADE_METRICS"] = entry.metrics
        if audit := entry.audit or around.audit:
            named["TRADE_AUDIT"] = str(self.beside(audit)) if entry.is_local else audit
        if entry.providers is not None and entry.is_local:
            known = os.environ.get("PYTHONPATH")
            named["PYTHONPATH"] = os.pathsep.join([str(self.path.parent.absolute()), *([known] if known else [])])
        return {**around.environment, **named}

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


def read_toml(path: Path) -> tuple[str, dict[str, Any]]:
    """Reads a TOML file; returns its text and its contents. Raises ConfigurationError."""
    try:
        text = path.read_text(encoding="utf-8")
        return text, read_toml_text(text)
    except FileNotFoundError:
        raise ConfigurationError(where=str(path), problem="there is no such file") from None
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror}") from None
    except ValueError as bad:  # no TOML, or no UTF-8
        raise ConfigurationError(where=str(path), problem=f"not valid TOML: {bad}") from None


def converted(raw: object, kind: type[_Read], path: Path, text: str, table: tuple[str, ...]) -> _Read:
    """Converts a table to its type. Raises ConfigurationError with the line."""
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as bad:
        said = str(bad)
    place = _AT.search(said)
    inside = place.group(1) if place else ""
    key = re.split(r"[.\[]", inside, maxsplit=1)[0]
    fields = _INSIDE.get(key, kind).__struct_encode_fields__
    problem = said[: place.start()] if place else said
    if unknown := _UNKNOWN.search(said):
        key, problem = key or unknown.group(1), f"unknown key {unknown.group(1)!r}; there is {', '.join(fields)}"
    elif missing := _MISSING.search(said):
        problem = f"{missing.group(1)} is missing"
    raise ConfigurationError(where=at(path, text, table, key), problem=problem)


def at(path: Path, text: str, table: tuple[str, ...], key: str) -> str:
    """Returns a place in a file, for errors."""
    return f"{path}:{line_of(text, table, key)}: {'.'.join((*table, key) if key else table)}"


def line_of(text: str, table: Sequence[str], key: str = "") -> int:
    """Returns the line of a key in a table of a TOML text; else of the table's header; else 1."""
    inside, found = False, 1
    wanted = re.compile(rf"""\s*["']?{re.escape(key)}["']?\s*=""")
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            names = [quoted or bare for quoted, bare in _NAME.findall(header.group(1))]
            inside = names[: len(table)] == list(table)
            found = number if inside and found == 1 else found
        elif inside and key and wanted.match(line):
            return number
    return found


def _some(names: Mapping[str, object]) -> str:
    return f"there is {', '.join(names)}"
