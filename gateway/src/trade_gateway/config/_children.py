"""The tables of containers that a gateway looks after: what a system file says of one, and how it is looked after."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from msgspec import Meta

from trade_gateway.config._tables import Around, ContainerSpec, Entry, Tables, converted

__all__ = ["Child", "Supervised", "read_children"]

_LEASE_S: Final = 10.0
_MISSES: Final = 4
"""So many questions in a row are not answered before a container counts as hung."""


class Supervised(Entry, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One container that a gateway starts, and starts again."""

    restart: Literal["always", "never"] = "always"
    """When its process has ended unasked."""
    restarts: Annotated[int, Meta(ge=0, le=1000)] = 10
    """So often within ``window_s``; then it is given up."""
    window_s: Annotated[float, Meta(gt=0)] = 300.0
    answers_within_s: Annotated[float, Meta(ge=0.2, le=600)] = 5.0
    """Who has not answered for so long hangs, and is ended."""
    save_every_s: Annotated[float, Meta(ge=1)] = 60.0
    """How often the state of its providers is saved; also when it is stopped."""
    max_rss_mb: Annotated[float, Meta(gt=0)] | None = None
    """Who has more resident memory is ended; none: as much as there is."""
    lease_from: str = ""
    """A gateway of another host, without whose word it is not up here, and which has it up if this host is lost."""
    stands_in_for: str = ""
    """The gateway of another host whose container this is; it is up here while that one is lost."""
    lease_s: Annotated[float, Meta(ge=2, le=600)] = _LEASE_S
    """With ``stands_in_for``: how long that one has it after it was heard of last."""

    @property
    def question_s(self) -> float:
        """How long it may take to answer one question."""
        return self.answers_within_s / _MISSES

    @property
    def misses(self) -> int:
        """How many questions it may leave unanswered."""
        return _MISSES


class Child(NamedTuple):
    """A container of this host, how it is started, and how it is looked after."""

    part: ContainerSpec
    terms: Supervised
    environment: Mapping[str, str]
    """All variables of its process."""

    @property
    def name(self) -> str:
        return self.part.name

    def starts_like(self, other: "Child") -> bool:
        """Whether the two differ only in how they are looked after."""
        return self._started == other._started

    @property
    def _started(self) -> tuple[object, ...]:
        words, environment, providers = list(self.part.words), self.part.environment, self.part.entry.providers
        return (words, environment, providers, *self.lease)

    @property
    def lease(self) -> tuple[str, str]:
        """Who it is leased from, whom it stands in for; both empty: neither."""
        return self.terms.lease_from, self.terms.stands_in_for


def read_children(
    path: Path, text: str, around: Around, tables: Mapping[str, Any], *, certified: bool
) -> tuple[Child, ...]:
    """The containers of a gateway file, in the order in which they are started.

    Args:
        path: of the file.
        text: of the file.
        around: what the file says for all of them.
        tables: those of ``[container.NAME]``.
        certified: whether the gateway proves who it is with a certificate.

    Raises:
        ConfigurationError: names the file, the line, the key and what would be right.
    """
    entries = {name: converted(table, Supervised, path, text, ("container", name)) for name, table in tables.items()}
    parts = _OfGateway(path, text, around, entries, certified=certified).parts()
    return tuple(Child(part, entries[part.name], {**around.inherited, **part.environment}) for part in parts)


class _OfGateway(Tables):
    """They run on the gateway's own host, and each proves by itself who it is."""

    def __init__(
        self, path: Path, text: str, around: Around, entries: Mapping[str, Supervised], *, certified: bool
    ) -> None:
        super().__init__(path, text, around, entries)
        self._certified = certified

    def check_kind(self, name: str, entry: Entry) -> None:
        super().check_kind(name, entry)
        if not entry.is_local:
            self.refuse(name, "host", "a gateway looks after containers of its own host; leave it out")
        if entry.gateway:
            self.refuse(name, "gateway", "is this file; a gateway looks after robots, providers, rules and doors")
        if isinstance(entry, Supervised):
            self._check_lease(name, entry)
        if self._certified and not entry.tls:
            self.refuse(name, "tls", f"missing; name the folder with its certificate: trade pki issue {name}")

    def _check_lease(self, name: str, entry: Supervised) -> None:
        key = "lease_from" if entry.lease_from else "stands_in_for"
        if not getattr(entry, key):
            if entry.lease_s != _LEASE_S:
                self.refuse(name, "lease_s", "goes with stands_in_for; leave it out")
            return
        if entry.lease_from and entry.stands_in_for:
            self.refuse(name, key, "of two gateways one leases it and the other one stands in; leave one of them out")
        if entry.lease_from and entry.lease_s != _LEASE_S:
            self.refuse(name, "lease_s", f"is for {entry.lease_from} to say; leave it out")
        if entry.providers is None:
            self.refuse(name, key, f"goes with providers; a {entry.kind} is pinned to its host; leave it out")
        if entry.restart == "never":
            self.refuse(name, "restart", f"does not go with {key}; leave one of them out")
