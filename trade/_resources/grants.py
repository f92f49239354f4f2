"""The records of the lock table: requests, grants and waiters."""

from collections.abc import Iterable

from msgspec import Struct

from trade._resources.resource import Holder, Resource
from trade.protocol.messages import Token


class LockRequest(Struct, frozen=True):
    """The terms of a lock request."""

    purpose: str = ""
    lease_s: float = 2.0
    wait_s: float = 0.0
    """How long to wait in the queue, and then for calls and motion to end."""
    priority: int = 0
    """Higher ones come first; a granted lock is not taken away."""
    delegates: tuple[str, ...] = ()
    """Identities that may use it, too."""


class Granted(Struct, frozen=True):
    """A lock's part in one container."""

    token: Token | None
    """None: the requesting call had locked everything already."""
    resources: tuple[str, ...]
    waited_s: float = 0.0
    """How long after the request it was granted; the lease began then."""


class LockInfo(Struct, frozen=True):
    """One grant, as `trade.locks` reports it; with number 0 a resource that could not be stopped (S14)."""

    token: Token
    container: str
    resources: tuple[str, ...]
    holder: Holder
    left_s: float
    """What is left of the lease."""
    uses: int
    """The number of calls made under it."""
    last_use: float
    """``time.time()`` of the last one; 0 for none."""
    waiting: tuple[str, ...]
    """The clients that wait for any of it, next first."""


class StopInfo(Struct, frozen=True):
    """A stop that holds a resource: nothing moves it before the e-stop is cleared, or the resource is resumed."""

    container: str
    resource: str
    by: str
    """The client that stopped it."""
    reason: str
    estop: bool = False
    """Whether an e-stop is open."""


class Waiter(Struct, eq=False):
    """A client that waits for resources."""

    order: tuple[int, int]
    resources: tuple[Resource, ...]
    holder: Holder
    calls: frozenset[int]
    """The calls that led to the request: it does not wait for them."""
    dropped: str = ""
    """Why it cannot get them any more."""


class Grant(Struct, eq=False):
    """Resources that one client holds under the same lease."""

    number: int
    resources: tuple[Resource, ...]
    holder: Holder
    lease_s: float
    until: float

    def info(self, epoch: str, container: str, now: float, waiting: Iterable[Waiter]) -> LockInfo:
        """The grant as others see it, with the waiters for any part of it."""
        in_vain = [one.holder for one in waiting if not set(one.resources).isdisjoint(self.resources)]
        return LockInfo(
            token=Token(epoch, self.number),
            container=container,
            resources=tuple(resource.name for resource in self.resources),
            holder=self.holder,
            left_s=max(0.0, self.until - now),
            uses=sum(resource.uses for resource in self.resources),
            last_use=max(resource.used_at for resource in self.resources),
            waiting=tuple(one.owner for one in in_vain),
        )


def withheld(resource: Resource, epoch: str, container: str) -> LockInfo:
    """The entry of a resource that could not be stopped: no client gets it before it is resumed."""
    purpose = f"could not be stopped ({resource.unsafe}); check it, then run `trade resume {resource.name}`"
    return LockInfo(
        token=Token(epoch, 0),
        container=container,
        resources=(resource.name,),
        holder=Holder("nobody", "", "", purpose, resource.unsafe_at),
        left_s=0.0,
        uses=0,
        last_use=0.0,
        waiting=(),
    )
