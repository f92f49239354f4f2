"""The system file: the containers of a system, their hosts and their order; checked as a whole."""

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, NamedTuple, cast

from msgspec import Meta, Struct

from trade import Settings
from trade.errors import ConfigurationError
from trade.policies import read_policy
from trade_gateway.config._children import Supervised
from trade_gateway.config._entry import ContainerSpec, ContainerTable, FileDefaults
from trade_gateway.config._gateway_file import read_gateway_file
from trade_gateway.config._supervised_system import is_supervised
from trade_gateway.config._tables import Tables, converted, read_entry
from trade_gateway.config._toml_file import at, line_of, read_toml

_SET_BY_GATEWAY: Final = ("tls", "policy", "audit", "metrics", "connect", "listen")
"""Keys that a gateway file sets instead of the system file."""

_Text = Annotated[str, Meta(min_length=1)]


class _System(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: _Text
    """The system id."""
    tls: str = ""
    """The certificate folder of `trade system`, and of containers of this host that name none."""
    policy: str = ""
    audit: str = ""
    """The folder of audit records of containers of this host that name none."""
    connect: list[_Text] = []
    supervisor: str = ""
    """The gateway that `trade system up` starts, and that keeps the containers of this host up."""


class SystemPlan(NamedTuple):
    """A checked system file, with the files that it names on this host."""

    path: Path
    settings: Settings
    """The settings of `trade system` itself."""
    parts: Sequence[ContainerSpec]
    """The containers in the order in which they are started."""
    text: str
    supervisor: str = ""
    """The container that starts and restarts those of ``supervised``."""
    supervised: frozenset[str] = frozenset()

    def at(self, name: str, key: str = "") -> str:
        """Returns the place of a container in the file, for errors."""
        return at(self.path, self.text, ("container", name), key)


def read_system_file(path: Path) -> SystemPlan:
    """Reads and checks a system file and the files of this host that it names, without a running system.

    Raises:
        ConfigurationError: with the file, the line, the key and the remedy.
    """
    text, raw = read_toml(path)
    for key in raw:
        if key not in ("system", "container"):
            problem = "unknown; there is [system] and [container.NAME]"
            raise ConfigurationError(where=f"{path}:{line_of(text, (key,), key)}: {key}", problem=problem)
    if not isinstance(raw.get("system"), dict):
        raise ConfigurationError(where=f"{path}:1: system", problem='missing; write [system] and name = "lab"')
    system = converted(raw["system"], _System, path, text, ("system",))
    tables = raw.get("container")
    if not isinstance(tables, dict) or not tables:
        raise ConfigurationError(where=f"{path}:1: container", problem="missing; write [container.NAME]")
    named = cast("dict[str, object]", tables)
    supervised = {name for name, table in named.items() if system.supervisor and is_supervised(table)}
    entries = {
        name: read_entry(table, Supervised if name in supervised else ContainerTable, path, text, ("container", name))
        for name, table in named.items()
    }
    defaults = FileDefaults(
        system=system.name, tls=system.tls, policy=system.policy, audit=system.audit, connect=system.connect
    )
    reading = _WithGateways(path, text, defaults, entries, supervised)
    settings, parts = _own_settings(reading, text), reading.parts()
    if system.supervisor:
        parts = [_keeper(path, text, system, supervised), *parts]
    return SystemPlan(path, settings, parts, text, system.supervisor, frozenset(supervised))


def _keeper(path: Path, text: str, system: _System, supervised: Collection[str]) -> ContainerSpec:
    """Returns the gateway that supervises the containers of this host: it reads the same file."""
    if not supervised or system.supervisor in supervised:
        problem = "it has the name of a container" if supervised else "no container of this host is for it to supervise"
        raise ConfigurationError(where=at(path, text, ("system",), "supervisor"), problem=problem)
    entry = ContainerTable(gateway=str(path.absolute()))
    read_gateway_file(path)  # checks what only a supervisor asks for
    return ContainerSpec(system.supervisor, entry, ["--system", system.name, "gateway", entry.gateway], {})


def _own_settings(reading: Tables, text: str) -> Settings:
    """Returns the settings of `trade system` itself."""
    system = reading.defaults
    environment = {**os.environ, **reading.environment(system.tls, system.policy)}
    try:
        if system.policy:
            read_policy(reading.beside(system.policy))
        settings = Settings.read(system=system.system, connect=system.connect, environment=environment)
        return replace(settings, audit=None, metrics="")  # it is short-lived
    except ConfigurationError as wrong:
        raise ConfigurationError(where=at(reading.path, text, ("system",), ""), problem=str(wrong)) from None


class _WithGateways(Tables):
    """Tables of a system file, where a container may be a gateway."""

    def __init__(
        self,
        path: Path,
        text: str,
        defaults: FileDefaults,
        entries: Mapping[str, ContainerTable],
        supervised: Collection[str],
    ) -> None:
        super().__init__(path, text, defaults, entries)
        self._supervised = supervised

    def check_kind(self, name: str, entry: ContainerTable) -> None:
        super().check_kind(name, entry)
        if entry.program is not None and name not in self._supervised:
            self.refuse(name, "program", 'only a supervisor starts programs; write supervisor = "keeper" in [system]')
        if name in self._supervised and (others := set(entry.after) - set(self._supervised)):
            problem = f"the supervisor of this host cannot wait for {', '.join(sorted(others))}; leave it out"
            self.refuse(name, "after", problem)
        for key in _SET_BY_GATEWAY if entry.gateway else ():
            if getattr(entry, key):
                self.refuse(name, key, "is set in the gateway file; leave it out")

    def check_here(self, name: str, entry: ContainerTable, environment: Mapping[str, str]) -> None:
        if not entry.gateway:
            super().check_here(name, entry, environment)
            return
        file = self.beside(entry.gateway)
        with self.errors_in(name, entry):
            settings = read_gateway_file(file).settings
        for key, actual, wanted in (
            ("name", settings.container, name),
            ("system", settings.system, self.defaults.system),
        ):
            if actual != wanted:
                self.refuse(name, "gateway", f"{file} has {key} = {actual!r}; here it is {wanted!r}")
