"""Which services exist, here and elsewhere; every container looks them up locally."""

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from trade._constraints import Constraint
from trade._index import Index
from trade._wire import HEALTHY, Address, Estop, ProviderInfo, Scalar, ServiceInfo, ServiceKey

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
    def label(self) -> str:
        """Group and name, as on the command line: ``rosie.head.move_to``."""
        return f"{self.groups[0] if self.groups else self.kind}.{self.info.name}"


@dataclass(slots=True)
class ContainerState:
    """What is known of one boot of one container."""

    address: Address
    alive: bool
    providers: dict[str, tuple[int, list[Record]]]
    removed: set[str]
    lost: bool = False
    """Whether it was alive before."""


class Change(NamedTuple):
    """What a message did to the registry."""

    joined: list[Record]
    left: list[Record]
    replaced: list[Record]
    """The same services, told anew."""
    before: list[Record]
    """What was known of those, in the same order."""


_MOST_ENDED: Final = 256
"""So many ended containers are remembered, for the one that comes back."""


class Registry:
    """Fed by the container's reader threads; asked by everybody.

    Entries of a container count while its sign of life stands, whichever of the two is heard first. Listeners are told
    in order, after the change, on the thread that fed it, with no lock held.
    """

    def __init__(self, own: Address) -> None:
        self._own = own
        self._containers: dict[Address, ContainerState] = {}
        self._records: Index[Record] = Index()
        self._changed = threading.Condition()
        self._telling = threading.RLock()
        self._listeners: list[Callable[[Change], None]] = []
        self.appear(own)

    def listen(self, listener: Callable[[Change], None]) -> None:
        self._listeners.append(listener)

    def between_changes(self, action: Callable[[], None]) -> None:
        """Do something that no change may come between; listeners are told before or after it."""
        with self._telling:
            action()

    # --- feeding

    def put(self, address: Address, domain: str, provider: str, info: ProviderInfo) -> None:
        """A provider's entry is there, or is there in a newer revision."""
        with self._telling:
            with self._changed:
                state = self._state(address)
                known = state.providers.get(provider)
                if provider in state.removed or (known is not None and known[0] >= info.revision):
                    return
                state.providers[provider] = (info.revision, self._make(address, domain, provider, info))
                change = self._swap(known[1] if known else [], state.providers[provider][1], state.alive)
            self._tell(change)

    def remove(self, address: Address, provider: str, *, for_good: bool = True) -> None:
        """A provider was deregistered; in this boot it never comes back, if that is sure."""
        with self._telling:
            with self._changed:
                state = self._state(address)
                if for_good:
                    state.removed.add(provider)
                _, records = state.providers.pop(provider, (0, []))
                change = self._swap(records, [], state.alive)
            self._tell(change)

    def appear(self, address: Address) -> None:
        """A container's sign of life rose."""
        with self._telling:
            with self._changed:
                state = self._state(address)
                was, state.alive, state.lost = state.alive, True, False
                change = self._swap([], [] if was else _all(state), alive=True)
            self._tell(change)

    def vanish(self, address: Address) -> None:
        """A container's sign of life fell; what it offered is gone unless the same boot comes back."""
        with self._telling:
            with self._changed:
                state = self._state(address)
                was, state.alive, state.lost = state.alive, False, True
                change = self._swap(_all(state) if was else [], [], alive=True)
                self._forget_ended()
            self._tell(change)

    def _state(self, address: Address) -> ContainerState:
        state = self._containers.get(address)
        if state is None:
            state = self._containers[address] = ContainerState(address, alive=False, providers={}, removed=set())
        return state

    def _forget_ended(self) -> None:
        ended = [address for address, state in self._containers.items() if not state.alive]
        for address in ended[:-_MOST_ENDED]:
            del self._containers[address]

    def _make(self, address: Address, domain: str, provider: str, info: ProviderInfo) -> list[Record]:
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
                meta={**service.meta, **info.meta},
                health=info.health,
                members=info.members,
                estops=info.estops,
            )
            for service in info.services
        ]

    def _swap(self, before: Iterable[Record], after: Iterable[Record], alive: bool) -> Change:
        """Replace records in the index, under the lock. What stays under its key neither joins nor leaves."""
        if not alive:
            return Change([], [], [], [])
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
            for listener in list(self._listeners):
                listener(change)

    # --- asking

    def get(self, key: ServiceKey) -> Record | None:
        return self._records.get(key)

    def select(self, constraint: Constraint) -> list[Record]:
        """Records that match, ordered by label and place."""
        records = [record for record in self._records.candidates(constraint) if constraint.matches(record)]
        return sorted(records, key=lambda record: (record.label, str(record.key.address), record.key.provider))

    def wait_for(self, ready: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until the condition holds after some change. Returns whether it does."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not ready():
                left = deadline - time.monotonic()
                if left <= 0:
                    return False
                self._changed.wait(left)
            return True

    def known_before(self, address: Address) -> set[str]:
        """The providers of a container whose sign of life fell: what it offered when it was heard last."""
        state = self._containers.get(address)
        return set(state.providers) if state is not None and state.lost else set()

    def is_alive(self, address: Address) -> bool:
        state = self._containers.get(address)
        return state is not None and state.alive

    def containers(self) -> list[ContainerState]:
        """The containers that are alive, by address."""
        return sorted((s for s in list(self._containers.values()) if s.alive), key=lambda s: str(s.address))

    def removed(self, key: ServiceKey) -> bool:
        """Whether the provider was deregistered in a boot that still lives."""
        state = self._containers.get(key.address)
        return state is not None and key.provider in state.removed


def _all(state: ContainerState) -> list[Record]:
    return [record for _, records in state.providers.values() for record in records]
