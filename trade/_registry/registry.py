"""The registry of all services in the system; every container has a copy for local lookups."""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from msgspec import Struct

from trade._registry.constraints import Constraint
from trade._registry.index import Index
from trade._registry.revision_tracker import RevisionTracker
from trade._threads.condition import InterruptibleCondition
from trade._threads.event import Event
from trade.errors import ServiceGone
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import HEALTHY, PROTOCOL, Estop, ProviderInfo, Scalar, ServiceInfo

_KNOWN_WITHIN_S: Final = 1.0


class Record(Struct, frozen=True):
    """One service in the registry."""

    key: ServiceKey
    info: ServiceInfo
    groups: tuple[str, ...]
    kind: str
    host: str
    pid: int
    local: bool
    kinds: tuple[str, ...]
    meta: Mapping[str, Scalar]
    health: str
    members: Mapping[str, tuple[str, ...]]
    estops: tuple[Estop, ...] = ()

    @property
    def healthy(self) -> bool:
        return self.health == HEALTHY

    @property
    def name(self) -> str:
        return self.info.name

    @property
    def container(self) -> str:
        return self.key.address.container

    @property
    def used(self) -> tuple[str, ...]:
        """The resources to lock for its use; a service without resources is locked by itself."""
        uses = () if self.info.effect == "read" else self.info.uses
        return uses or (f"{self.key.domain}/{self.key.provider}/{self.key.name}",)

    @property
    def label(self) -> str:
        """Group and name, as on the command line: ``rosie.head.move_to``."""
        return f"{self.groups[0] if self.groups else self.kind}.{self.info.name}"


class Announcement(NamedTuple):
    """The announcement of one provider, and the records made from it."""

    domain: str
    info: ProviderInfo
    records: list[Record]
    """Empty if the container may not offer the provider."""


MayOffer = Callable[[str, str, str, Sequence[str]], bool]
"""Whether an identity may offer a provider: identity, domain, provider, groups."""


def _every_identity(_identity: str, _domain: str, _provider: str, _groups: Sequence[str]) -> bool:
    return True


@dataclass(slots=True)
class ContainerState:
    """The state of one boot of one container while its sign of life is present."""

    address: Address
    providers: dict[str, "Announcement"] = field(default_factory=dict)
    """By name."""
    removed: dict[str, str] = field(default_factory=dict)
    """Deregistered providers in order, with their new places if they moved: no name is used twice in one boot."""
    unlisted: set[str] = field(default_factory=set[str])
    """Those of `removed` that a reply no longer listed: a gateway may export them again."""
    heard: RevisionTracker = field(default_factory=RevisionTracker)
    transport: str = ""
    """The id of its transport, from its reply; empty before that."""
    protocol: int = 0
    """Its protocol version; 0 before its first message. If it differs from ours, it has no providers here."""
    estops: dict[str, tuple[Estop, ...]] = field(default_factory=dict)
    """For a container of another version: its open e-stops, by the provider that reports them."""

    def open_estops(self) -> list[Estop]:
        """The open e-stops of ``estops``."""
        return [estop for opened in list(self.estops.values()) for estop in opened]


class Change(NamedTuple):
    """The effect of one message on the registry."""

    joined: list[Record]
    left: list[Record]
    replaced: list[Record]
    """The same services with new data."""
    before: list[Record]
    """The previous records of those, in the same order."""


_logger = logging.getLogger("trade")

_SLASHES: Final = 4
"""Slashes in the text that names a provider's new place."""
_MOST_GUESTS: Final = 64
"""The most containers of one identity without services that are registered."""
_MOST_PROVIDERS: Final = 65_536
"""The most providers of one container: further announcements are ignored, and further withdrawals not stored."""


class Registry:
    """Written by the container's reader threads; read by all threads.

    A container has an entry only while its sign of life is present: when that appears, it is queried for all its
    services. Subscribers are called in order, after the change, on the thread that made it, without a lock.
    """

    def __init__(
        self,
        own: Address,
        may_offer: MayOffer = _every_identity,
        may_offer_anything: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._own = own
        self._may_offer = may_offer
        self._may_offer_anything = may_offer_anything
        self._crowds: set[str] = set()
        """Identities for which too many containers were logged."""
        self._containers: dict[Address, ContainerState] = {}
        self._records: Index[Record] = Index()
        self._lock = threading.RLock()
        self._changed = InterruptibleCondition()
        self._notifying = threading.RLock()
        self.changes: Final = Event[Change]()
        """Services that joined, left or were replaced."""
        self.appear(own)
        self.speaks(own, PROTOCOL)

    def between_changes(self, action: Callable[[], None]) -> None:
        """Run an action between two changes; subscribers are called before or after it."""
        with self._notifying:
            action()

    # --- feeding

    def put(self, address: Address, domain: str, provider: str, info: ProviderInfo) -> bool:
        """A container announces a provider, or its end. Returns whether no earlier announcement was missed."""
        with self._notifying:
            with self._lock:
                state = self._containers.get(address)
                if state is None:
                    return True
                if info.revision <= state.heard.answered:  # its reply contained this revision
                    return state.heard.complete
                state.protocol = PROTOCOL
                state.heard.announced(info.revision)
                change = self._change(state, {provider: (domain, info)}, [] if info.services else [provider])
            self._notify(change)
            return state.heard.complete

    def count(self, address: Address, revision: int) -> bool:
        """A container announces its revision. Returns whether no announcement was missed."""
        with self._lock:
            state = self._containers.get(address)
            if state is None:
                return True
            state.protocol = PROTOCOL
            state.heard.counted(revision)
            return state.heard.complete

    def speaks(self, address: Address, version: int) -> bool:
        """A container uses a protocol version. Returns whether that is news."""
        with self._lock:
            state = self._containers.get(address)
            if state is None or state.protocol == version:
                return False
            state.protocol = version
            self._changed.notify_all()
            return True

    def set_open_estops(self, address: Address, domain: str, provider: str, estops: tuple[Estop, ...]) -> bool:
        """A container of another version reports open e-stops. Returns whether it is registered and may report them."""
        if not self._may_offer(address.identity, domain, provider, (domain,)):
            return False
        with self._lock:
            state = self._containers.get(address)
            if state is None or (provider not in state.estops and len(state.estops) >= _MOST_PROVIDERS):
                return False
            state.estops[provider] = estops
            self._changed.notify_all()
            return True

    def settle(self, state: ContainerState, revision: int, offered: Mapping[str, tuple[str, ProviderInfo]]) -> None:
        """A container has replied with all its services at a revision: from provider to domain and entry.

        A reply to a query from before its sign of life disappeared is ignored.
        """
        with self._notifying:
            with self._lock:
                if self._containers.get(state.address) is not state or revision < state.heard.answered:
                    return
                known = state.providers.items()
                gone = [name for name, entry in known if name not in offered and entry.info.revision <= revision]
                for name in state.unlisted.intersection(offered):
                    state.removed.pop(name, None)
                state.unlisted = (state.unlisted | set(gone)).difference(offered)
                state.protocol = PROTOCOL
                state.heard.replied(revision)
                change = self._change(state, offered, gone)
                self._changed.notify_all()
            self._notify(change)

    def appear(self, address: Address) -> bool:
        """A container's sign of life appeared. Returns whether that is news."""
        with self._lock:
            if address in self._containers or not self._has_room_for(address):
                return False
            self._containers[address] = ContainerState(address)
            self._changed.notify_all()
            return True

    def reopen(self, address: Address) -> bool:
        """A container is back behind a bridge that may let other services cross. Returns whether it is registered.

        What is known of it stays until its next reply.
        """
        with self._lock:
            state = self._containers.get(address)
            if state is not None:
                state.heard.reopen()
            return state is not None

    def counts(self, state: ContainerState) -> bool:
        """Whether a container has listed its services, or may have some: by the policy, not all may."""
        return state.heard.complete or self._may_offer_anything(state.address.identity)

    def _has_room_for(self, address: Address) -> bool:
        if self._may_offer_anything(address.identity):
            return True
        known = sum(other.identity == address.identity for other in self._containers)
        if known < _MOST_GUESTS:
            return True
        if address.identity not in self._crowds:
            self._crowds.add(address.identity)
            _logger.warning("%s has %d containers and may offer nothing: others are ignored", address.identity, known)
        return False

    def vanish(self, address: Address) -> None:
        """A container's sign of life disappeared: remove it until it returns and is queried."""
        with self._notifying:
            with self._lock:
                state = self._containers.pop(address, None)
                change = self._swap([] if state is None else _all(state), [])
            self._notify(change)

    def _change(
        self, state: ContainerState, entries: Mapping[str, tuple[str, ProviderInfo]], gone: Sequence[str]
    ) -> Change:
        """Add what is newer than the current state, and remove what is gone permanently. Under the lock."""
        before, after = list[Record](), list[Record]()
        for provider in gone:
            before += _records(state.providers.pop(provider, None))
        state.removed.update((name, entries[name][1].moved_to if name in entries else "") for name in gone)
        for provider in list(state.removed)[: max(0, len(state.removed) - _MOST_PROVIDERS)]:
            del state.removed[provider]
        for provider, (domain, info) in entries.items():
            known = state.providers.get(provider)
            if provider in state.removed or (known is not None and known.info.revision >= info.revision):
                continue
            if known is None and len(state.providers) >= _MOST_PROVIDERS:
                continue
            made = self._make(state.address, domain, provider, info)
            state.providers[provider] = Announcement(domain, info, made)
            before += _records(known)
            after += made
        return self._swap(before, after)

    def recheck_access(self) -> None:
        """The rights to offer have changed: remove services that may no longer be offered, add those that may now."""
        with self._notifying:
            with self._lock:
                before, after = list[Record](), list[Record]()
                for state in self._containers.values():
                    for provider, entry in state.providers.items():
                        made = self._make(state.address, entry.domain, provider, entry.info)
                        if bool(made) != bool(entry.records):
                            state.providers[provider] = entry._replace(records=made)
                            before += entry.records
                            after += made
                change = self._swap(before, after)
            self._notify(change)

    def _make(self, address: Address, domain: str, provider: str, info: ProviderInfo) -> list[Record]:
        if not self._may_offer(address.identity, domain, provider, info.groups):
            return []
        return records_of(address, domain, provider, info, local=address == self._own)

    def _swap(self, before: Iterable[Record], after: Iterable[Record]) -> Change:
        """Replace records in the index, under the lock. A service that keeps its key neither joins nor leaves."""
        old = {record.key: record for record in before}
        new = {record.key: record for record in after}
        for record in new.values():
            self._records.put(record)
        for key in old:
            if key not in new:
                self._records.remove(key)
        self._changed.notify_all()
        return Change(
            joined=[new[key] for key in new if key not in old],
            left=[old[key] for key in old if key not in new],
            replaced=[new[key] for key in new if key in old],
            before=[old[key] for key in new if key in old],
        )

    def _notify(self, change: Change) -> None:
        if any(change):
            self.changes.emit(change)

    # --- asking

    def get(self, key: ServiceKey) -> Record | None:
        return self._records.get(key)

    def select(self, constraint: Constraint) -> list[Record]:
        """Records that match, ordered by label and place."""
        records = [record for record in self._records.candidates(constraint) if constraint.matches(record)]
        if len(records) > 1:
            records.sort(key=lambda record: (record.label, str(record.key.address), record.key.provider))
        return records

    def wait_for(self, ready: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until the condition holds after some change. Returns whether it does."""

        def holds() -> bool:
            with self._lock:
                return ready()

        return self._changed.wait_for(holds, timeout_s)

    def wait_until_known(self, keys: Iterable[ServiceKey]) -> None:
        """Wait, for a second at most, for the announcements of services that another container knows already."""
        wanted = [key for key in keys if not self.removed(key)]
        self.wait_for(lambda: all(self.get(key) is not None for key in wanted), _KNOWN_WITHIN_S)

    def is_alive(self, address: Address) -> bool:
        return address in self._containers

    def left_open(self, address: Address) -> bool:
        """Whether a container is alive and an announcement of it may have been missed."""
        state = self._containers.get(address)
        return state is not None and not state.heard.complete

    def containers(self) -> list[ContainerState]:
        """The containers that are alive, by address."""
        states = list(self._containers.values())  # a copy, as other threads change it
        return sorted(states, key=lambda state: str(state.address))

    def removed(self, key: ServiceKey) -> bool:
        """Whether the provider was deregistered in a boot that is still alive."""
        state = self._containers.get(key.address)
        return state is not None and key.provider in state.removed

    def moved_to(self, key: ServiceKey) -> str:
        """The new place of a provider that moved: ``identity/container/epoch/domain/provider``."""
        state = self._containers.get(key.address)
        return "" if state is None else state.removed.get(key.provider, "")


def records_of(address: Address, domain: str, provider: str, info: ProviderInfo, *, local: bool) -> list[Record]:
    """The entries of a provider's services."""
    return [
        Record(
            key=ServiceKey(address, domain, provider, service.name),
            info=service,
            groups=info.groups,
            kind=info.kind,
            host=info.host,
            pid=info.pid,
            local=local,
            kinds=info.kinds,
            meta={**service.meta, **info.meta} if service.meta and info.meta else service.meta or info.meta,
            health=info.health,
            members=info.members,
            estops=info.estops,
        )
        for service in info.services
    ]


def gone_to(label: str, moved_to: str) -> ServiceGone:
    """The error for a caller of a service that has moved."""
    container = moved_to.split("/")[1] if moved_to.count("/") == _SLASHES else "another one"
    return ServiceGone(service=label, reason=f"its provider has moved to container {container}", moved_to=moved_to)


def _all(state: ContainerState) -> list[Record]:
    return [record for entry in state.providers.values() for record in entry.records]


def _records(entry: Announcement | None) -> list[Record]:
    return [] if entry is None else entry.records
