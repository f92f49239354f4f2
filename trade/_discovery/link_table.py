"""How a container is linked and can be reached: with which containers, since when, by which endpoints."""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Literal

from msgspec import Struct

from trade._discovery.dialer import Dialer
from trade._registry.registry import Record, Registry
from trade._security.certificates import Certificate
from trade.protocol.keys import CLOCK, DOMAIN, PROVIDER, Address, ServiceKey
from trade.transport.zenoh_links import Link, Links

Tell = Callable[[Literal["linked", "unlinked"], str, str, "Record | None"], None]
"""Takes the kind of an event, the container at the other end, its endpoint, and its service ``clock``."""


class LinkInfo(Struct, frozen=True, kw_only=True):
    """One link."""

    to: str
    """The container at the other end; empty if none is known there."""
    identity: str
    """The identity of that container."""
    here: str
    """The endpoint of this end."""
    there: str
    """The endpoint of the other end."""
    dialled: bool
    """Whether this end dialled the other one."""
    bridge: bool
    """Whether the other end is a bridge."""
    linked_s: float
    """The time since the link was first seen, which is up to 2 s after it was made."""
    calls: int
    """The calls of the reporting container that the other one has answered, on the local path too. The other end counts
    those in the other direction."""


class NetworkInfo(Struct, frozen=True, kw_only=True):
    """The network of a container."""

    container: str
    listens: list[str]
    """The endpoints that it listens on."""
    dials: dict[str, bool]
    """The endpoints that it dials, and whether a link leads to each."""
    bridge: list[str]
    """The interfaces between which it passes messages on; empty: it is no bridge."""
    discovery: bool
    """Whether it searches for containers that broadcast."""
    broadcast: bool
    """Whether it answers such searches."""
    certificate_ends: float | None
    """The end of its certificate, in seconds since the epoch; None: it has none."""
    links: list[LinkInfo]
    """Its direct links."""
    moved: bool = False
    """Whether it listens on all interfaces, and their addresses are no longer those of its start."""


class _LinkRecord(Struct):
    """A link that exists, and what was said about it."""

    since_ns: int
    to: Address | None = None
    clock: Record | None = None


class LinkTable:
    """Compares the links with those at the last look. On a transport without links, it is empty."""

    def __init__(
        self,
        links: Links | None,
        registry: Registry,
        answers: Callable[[Address], int],
        callback: Tell,
    ) -> None:
        self._links = links
        self._registry = registry
        self._answers = answers
        self._tell = callback
        self._looking = threading.Lock()
        self._records: dict[Link, _LinkRecord] = {}

    def infos(self) -> list[LinkInfo]:
        """The links at this moment; also reports those to containers that came or went since the last time."""
        if self._links is None:
            return []
        with self._looking:
            current = self._links.current()
            if current is None:
                return []
            came, went = self._compare(current)
            seen = dict(self._records)
        for link, one in went:
            self._report("unlinked", link, one)
        for link, one in came:
            self._report("linked", link, one)
        now_ns = time.monotonic_ns()
        return [self._info(link, one, now_ns) for link, one in seen.items()]

    def _compare(self, current: list[Link]) -> tuple[list[tuple[Link, _LinkRecord]], list[tuple[Link, _LinkRecord]]]:
        """The links to known containers that came, and those that went. Requires the lock."""
        there = set(current)
        known = {state.transport: state.address for state in self._registry.containers() if state.transport}
        went = [(link, one) for link, one in self._records.items() if link not in there and one.to is not None]
        self._records = {link: self._records.get(link) or _LinkRecord(time.monotonic_ns()) for link in current}
        came: list[tuple[Link, _LinkRecord]] = []
        for link, one in self._records.items():
            if one.to is None and (to := known.get(link.session)) is not None:
                one.to, one.clock = to, clock_of(self._registry, to)
                came.append((link, one))
        return came, went

    def _report(self, kind: Literal["linked", "unlinked"], link: Link, one: _LinkRecord) -> None:
        self._tell(kind, "" if one.to is None else one.to.container, link.there, one.clock)

    def _info(self, link: Link, one: _LinkRecord, now_ns: int) -> LinkInfo:
        return LinkInfo(
            to="" if one.to is None else one.to.container,
            identity="" if one.to is None else one.to.identity,
            here=link.here,
            there=link.there,
            dialled=link.dialled,
            bridge=link.bridge,
            linked_s=(now_ns - one.since_ns) / 1e9,
            calls=0 if one.to is None else self._answers(one.to),
        )


def clock_of(registry: Registry, address: Address) -> Record | None:
    """The service ``clock`` of a container, which events about the container are about."""
    return registry.get(ServiceKey(address, DOMAIN, PROVIDER, CLOCK))


def network(
    container: str,
    dialer: Dialer | None,
    links: Links | None,
    table: LinkTable,
    bridge: Sequence[str],
    certificate: Certificate | None,
) -> NetworkInfo:
    """How a container is linked and can be reached now."""
    return NetworkInfo(
        container=container,
        listens=[] if links is None else list(map(str, links.listen)),
        dials={} if dialer is None else dialer.dialled(),
        bridge=list(bridge),
        discovery=dialer is not None and dialer.discovers,
        broadcast=dialer is not None and dialer.broadcasts,
        certificate_ends=None if certificate is None else certificate.until.timestamp(),
        links=table.infos(),
        moved=links is not None and links.moved(),
    )
