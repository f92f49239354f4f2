"""Tables of the containers that a gateway supervises: those of a system file, with keys for supervision."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from msgspec import Meta

from trade_gateway.config._entry import ContainerSpec, ContainerTable, FileDefaults
from trade_gateway.config._tables import Tables, read_entry

_LEASE_S: Final = 10.0
_MISSES: Final = 4
"""How many health checks in a row may fail before a container counts as hung."""


class Supervised(ContainerTable, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One container that a gateway starts and restarts."""

    restart: Literal["always", "never"] = "always"
    """Whether to restart it when its process ended by itself."""
    restarts: Annotated[int, Meta(ge=0, le=1000)] = 10
    """The most restarts within ``window_s``; then it is given up."""
    window_s: Annotated[float, Meta(gt=0)] = 300.0
    answers_within_s: Annotated[float, Meta(ge=0.2, le=600)] = 5.0
    """How long it may fail to answer before it counts as hung and is ended."""
    save_every_s: Annotated[float, Meta(ge=1)] = 60.0
    """The interval at which its providers' state is saved; also saved when it is stopped."""
    max_rss_mb: Annotated[float, Meta(gt=0)] | None = None
    """Resident memory above which it is ended; None: no limit."""
    lease_from: str = ""
    """A gateway of another host whose lease it needs to run here, and which runs it if this host is lost."""
    stands_in_for: str | list[str] = ""
    """The gateway of another host that has this container, or several; it runs here while their hosts are lost."""
    move_above: Annotated[float, Meta(gt=0, le=1)] | None = None
    """With ``stands_in_for``: the load of its host, as a share of all cores, above which it moves to another one."""
    lease_s: Annotated[float, Meta(ge=2, le=600)] = _LEASE_S
    """With ``stands_in_for``: how long that gateway has the container after its last sign of life."""

    @property
    def question_s(self) -> float:
        """The interval of health checks and, except for a command, the timeout of one."""
        return self.answers_within_s / _MISSES if self.health is None else self.health.every_s

    @property
    def askers(self) -> tuple[str, ...]:
        """The gateways that it is a standby for."""
        named = [self.stands_in_for] if isinstance(self.stands_in_for, str) else self.stands_in_for
        return tuple(name for name in named if name)

    @property
    def silence(self) -> str:
        """What it did if too many health checks failed."""
        if self.health is None:
            return f"it did not answer within {self.answers_within_s:g} s"
        return f"its health command failed {_MISSES} times in a row"

    @property
    def misses(self) -> int:
        """How many health checks may fail."""
        return _MISSES


class Child(NamedTuple):
    """A container of this host, with how it is started and supervised."""

    part: ContainerSpec
    terms: Supervised
    environment: Mapping[str, str]
    """All variables of its process."""

    @property
    def name(self) -> str:
        return self.part.name

    def starts_like(self, other: "Child") -> bool:
        """Whether the two differ only in their supervision."""
        return self._started == other._started

    @property
    def _started(self) -> tuple[object, ...]:
        part, entry = self.part, self.part.entry
        program = (entry.folder, entry.announces, entry.grace_s, entry.log_mb)
        return (list(part.words), part.environment, entry.providers, *program, *self.lease)

    @property
    def lease(self) -> tuple[str, str]:
        """The gateway that leases it, and the gateways that it is a standby for; both may be empty."""
        return self.terms.lease_from, ",".join(self.terms.askers)


def read_children(
    path: Path, text: str, defaults: FileDefaults, tables: Mapping[str, Any], *, certified: bool
) -> tuple[Child, ...]:
    """Reads the containers of a gateway file, in the order in which they are started.

    Args:
        path: the file.
        text: the file's text.
        defaults: settings of the file for all containers.
        tables: the tables ``[container.NAME]``.
        certified: whether the gateway has a certificate.

    Raises:
        ConfigurationError: with the file, the line, the key and the remedy.
    """
    entries = {name: read_entry(table, Supervised, path, text, ("container", name)) for name, table in tables.items()}
    parts = _OfGateway(path, text, defaults, entries, certified=certified).parts()
    return tuple(Child(part, entries[part.name], {**defaults.inherited, **part.environment}) for part in parts)


class _OfGateway(Tables):
    """Tables of containers on the gateway's own host, each with its own certificate."""

    def __init__(
        self, path: Path, text: str, defaults: FileDefaults, entries: Mapping[str, Supervised], *, certified: bool
    ) -> None:
        super().__init__(path, text, defaults, entries)
        self._certified = certified

    def check_kind(self, name: str, entry: ContainerTable) -> None:
        super().check_kind(name, entry)
        if not entry.is_local:
            self.refuse(name, "host", "a gateway supervises containers of its own host; leave it out")
        if entry.gateway:
            self.refuse(name, "gateway", "is this file; a gateway supervises robots, providers, programs and the like")
        if isinstance(entry, Supervised):
            self._check_lease(name, entry)
        if self._certified and not entry.tls:
            self.refuse(name, "tls", f"missing; name the folder with its certificate: trade pki issue {name}")

    def _check_lease(self, name: str, entry: Supervised) -> None:
        key = "lease_from" if entry.lease_from else "stands_in_for"
        if not getattr(entry, key):
            for other, default in (("lease_s", _LEASE_S), ("move_above", None)):
                if getattr(entry, other) != default:
                    self.refuse(name, other, "goes with stands_in_for; leave it out")
            return
        if twice := [one for one in entry.askers if entry.askers.count(one) > 1]:
            self.refuse(name, key, f"names {twice[0]} twice")
        if entry.lease_from and entry.stands_in_for:
            self.refuse(
                name, key, "one of two gateways leases it and the other one is the standby; leave one of them out"
            )
        for other, default in (("lease_s", _LEASE_S), ("move_above", None)):
            if entry.lease_from and getattr(entry, other) != default:
                self.refuse(name, other, f"is set in the file of {entry.lease_from}; leave it out")
        if entry.providers is None:
            self.refuse(name, key, f"goes with providers; a {entry.kind} is pinned to its host; leave it out")
        if entry.restart == "never":
            self.refuse(name, "restart", f"does not go with {key}; leave one of them out")
