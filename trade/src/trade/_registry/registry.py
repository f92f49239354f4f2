"""Which services exist, here and elsewhere; every container looks them up locally."""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from trade._protocol.keys import Address, ServiceKey
from trade._protocol.messages import HEALTHY, PROTOCOL, Estop, ProviderInfo, Scalar, ServiceInfo
from trade._registry.constraints import Constraint
from trade._registry.index import Index
from trade._registry.revision_tracker import RevisionTracker
from trade._threads.condition import InterruptibleCondition
from trade._threads.event import Event
from trade.errors import ServiceGone

__all__ = ["ContainerState", "Record", "Registry"]


@dataclass(frozen=True, slots=True)
class Record:
    """One service as the registry knows it."""

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
        """What to lock for its use: a service that names no resources stands for itself."""
        uses = () if self.info.effect == "read" else self.info.uses
        return uses or (f"{self.key.domain}/{self.key.provider}/{self.key.name}",)

    @property
    def label(self) -> str:
        """Group and name, as on the command line: ``rosie.head.move_to``."""
        return f"{self.groups[0] if self.groups else self.kind}.{self.info.name}"


class Entry(NamedTuple):
    """What a container says of one provider, and what is known by it."""

    domain: str
    info: ProviderInfo
    records: list[Record]
    """None of them if the container may not offer it."""


MayOffer = Callable[[str, str, str, Sequence[str]], bool]
"""Whether an identity may offer a provider: identity, domain, provider, groups."""


def _anybody(_identity: str, _domain: str, _provider: str, _groups: Sequence[str]) -> bool:
    return True


@dataclass(slots=True)
class ContainerState:
    """What is known of one boot of one container while its sign of life stands."""

    address: Address
    providers: dict[str, "Entry"] = field(default_factory=dict)
    """By name."""
    removed: dict[str, str] = field(default_factory=dict)
    """Deregistered, in this order, and where they moved, if they did: a name is never used twice in one boot."""
    heard: RevisionTracker = field(default_factory=RevisionTracker)
    protocol: int = 0
    """The version that it speaks; 0 before it has said anything. If it is not ours, it has no providers here."""
    estops: dict[str, tuple[Estop, ...]] = field(default_factory=dict)
    """Of one that speaks another version: what is open there, by the provider that tells of it."""

    def open_estops(self) -> list[Estop]:
        """See ``estops``."""
        return [estop for told in list(self.estops.values()) for estop in told]


class Change(NamedTuple):
    """What a message did to the registry."""

    joined: list[Record]
    left: list[Record]
    replaced: list[Record]
    """The same services, told anew."""
    before: list[Record]
    """What was known of those, in the same order."""


_logger = logging.getLogger("trade")

_SLASHES: Final = 4
"""In what says where a provider moved."""
_MOST_GUESTS: Final = 64
"""So many containers of one identity are known that may offer nothing."""
_MOST_PROVIDERS: Final = 65_536
"""Of one container: what it announces beyond that is ignored, and of more no withdrawal is remembered."""


class Registry:
    """Fed by the container's reader threads; asked by everybody.

    Of a container something is known only while its sign of life stands: when that rises it is asked for all it
    offers. Listeners are told in order, after the change, on the thread that fed it, with no lock held.
    """

    def __init__(
        self,
        own: Address,
        may_offer: MayOffer = _anybody,
        may_offer_anything: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._own = own
        self._may_offer = may_offer
        self._may_offer_anything = may_offer_anything
        self._crowds: set[str] = set()
        """Identities that were logged for having too many containers."""
        self._containers: dict[Address, ContainerState] = {}
        self._records: Index[Record] = Index()
        self._lock = threading.RLock()
        self._changed = InterruptibleCondition()
        self._telling = threading.RLock()
        self.changes: Final = Event[Change]()
        """What has joined, left or been replaced."""
        self.appear(own)
        self.speaks(own, PROTOCOL)

    def between_changes(self, action: Callable[[], None]) -> None:
        """Do something that no change may come between; subscribers are told before or after it."""
        with self._telling:
            action()

    # --- feeding

    def put(self, address: Address, domain: str, provider: str, info: ProviderInfo) -> bool:
        """A container announces a provider, or that one is gone. Returns whether nothing was missed before it."""
        with self._telling:
            with self._lock:
                state = self._containers.get(address)
                if state is None:
                    return True
                if info.revision <= state.heard.answered:  # its answer told of that, and of what came after it
                    return state.heard.complete
                state.protocol = PROTOCOL
                state.heard.told(info.revision)
                change = self._change(state, {provider: (domain, info)}, [] if info.services else [provider])
            self._tell(change)
            return state.heard.complete

    def count(self, address: Address, revision: int) -> bool:
        """A container says how much it has announced. Returns whether nothing of it was missed."""
        with self._lock:
            state = self._containers.get(address)
            if state is None:
                return True
            state.protocol = PROTOCOL
            state.heard.counted(revision)
            return state.heard.complete

    def speaks(self, address: Address, version: int) -> bool:
        """A container speaks a version. Returns whether that is news."""
        with self._lock:
            state = self._containers.get(address)
            if state is None or state.protocol == version:
                return False
            state.protocol = version
            self._changed.notify_all()
            return True

    def tells_open(self, address: Address, domain: str, provider: str, estops: tuple[Estop, ...]) -> bool:
        """One that speaks another version tells what is open there. Returns whether it is there and may tell that."""
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
        """A container has answered with all it offered at a revision: provider to domain and entry.

        An answer to what was asked before its sign of life fell is none.
        """
        with self._telling:
            with self._lock:
                if self._containers.get(state.address) is not state or revision < state.heard.answered:
                    return
                known = state.providers.items()
                gone = [name for name, entry in known if name not in offered and entry.info.revision <= revision]
                state.protocol = PROTOCOL
                state.heard.all_told(revision)
                change = self._change(state, offered, gone)
                self._changed.notify_all()
            self._tell(change)

    def appear(self, address: Address) -> bool:
        """A container's sign of life rose. Returns whether it is news."""
        with self._lock:
            if address in self._containers or not self._has_room_for(address):
                return False
            self._containers[address] = ContainerState(address)
            self._changed.notify_all()
            return True

    def _has_room_for(self, address: Address) -> bool:
        if self._may_offer_anything(address.identity):
            return True
        known = sum(other.identity == address.identity for other in self._containers)
        if known < _MOST_GUESTS:
            return True
        if address.identity not in self._crowds:
            self._crowds.add(address.identity)
            _logger.warning("%s has %d containers and may offer nothing: no more are known", address.identity, known)
        return False

    def vanish(self, address: Address) -> None:
        """A container's sign of life fell; it is known no more, until it returns and is asked."""
        with self._telling:
            with self._lock:
                state = self._containers.pop(address, None)
                change = self._swap([] if state is None else _all(state), [])
            self._tell(change)

    def _change(
        self, state: ContainerState, entries: Mapping[str, tuple[str, ProviderInfo]], gone: Sequence[str]
    ) -> Change:
        """Take up what is newer than known, and let go of what is gone for good. Under the lock."""
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
            state.providers[provider] = Entry(domain, info, made)
            before += _records(known)
            after += made
        return self._swap(before, after)

    def recheck_access(self) -> None:
        """Who may offer what has changed: what may no longer be offered leaves, what now may be joins."""
        with self._telling:
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
            self._tell(change)

    def _make(self, address: Address, domain: str, provider: str, info: ProviderInfo) -> list[Record]:
        if not self._may_offer(address.identity, domain, provider, info.groups):
            return []
        return [
            Record(
                key=ServiceKey(address, domain, provider, service.name),
                info=service,
                groups=info.groups,
                kind=info.kind,
                host=info.host,
                pid=info.pid,
                local=address == self._own,
                kinds=info.kinds,
                meta={**service.meta, **info.meta} if service.meta and info.meta else service.meta or info.meta,
                health=info.health,
                members=info.members,
                estops=info.estops,
            )
            for service in info.services
        ]

    def _swap(self, before: Iterable[Record], after: Iterable[Record]) -> Change:
        """Replace records in the index, under the lock. What stays under its key neither joins nor leaves."""
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

    def _tell(self, change: Change) -> None:
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

    def is_alive(self, address: Address) -> bool:
        return address in self._containers

    def left_open(self, address: Address) -> bool:
        """Whether a container is alive and something it announced may have been missed."""
        state = self._containers.get(address)
        return state is not None and not state.heard.complete

    def containers(self) -> list[ContainerState]:
        """The containers that are alive, by address."""
        states = list(self._containers.values())  # at once, as others change it
        return sorted(states, key=lambda state: str(state.address))

    def removed(self, key: ServiceKey) -> bool:
        """Whether the provider was deregistered in a boot that still lives."""
        state = self._containers.get(key.address)
        return state is not None and key.provider in state.removed

    def moved_to(self, key: ServiceKey) -> str:
        """Where its provider moved, if it was deregistered for that: ``identity/container/epoch/domain/provider``."""
        state = self._containers.get(key.address)
        return "" if state is None else state.removed.get(key.provider, "")


def gone_to(label: str, moved_to: str) -> ServiceGone:
    """The error of who calls a service that has moved."""
    container = moved_to.split("/")[1] if moved_to.count("/") == _SLASHES else "another one"
    return ServiceGone(service=label, reason=f"its provider has moved to container {container}", moved_to=moved_to)


def _all(state: ContainerState) -> list[Record]:
    return [record for entry in state.providers.values() for record in entry.records]


def _records(entry: Entry | None) -> list[Record]:
    return [] if entry is None else entry.records
