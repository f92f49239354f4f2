"""What the lock table keeps: requests, grants, and who waits."""

from collections.abc import Iterable

from msgspec import Struct

from trade._protocol.messages import Token
from trade._resources.resource import Holder, Resource


class LockRequest(Struct, frozen=True):
    """How somebody wants a lock."""

    purpose: str = ""
    lease_s: float = 2.0
    wait_s: float = 0.0
    """How long to stand in the queue, and then to wait for what still runs and moves."""
    priority: int = 0
    """Higher ones come first; whoever has it keeps it."""
    delegates: tuple[str, ...] = ()
    """Identities that may use it, too."""


class Granted(Struct, frozen=True):
    """A lock's part in one container."""

    token: Token | None
    """None: everything asked for was locked by the asking call already."""
    resources: tuple[str, ...]
    waited_s: float = 0.0
    """How long after it was asked for; the lease began then."""


class LockInfo(Struct, frozen=True):
    """One grant, as `trade.locks` tells it; or, with number 0 and of "nobody", what could not be stopped (S14)."""

    token: Token
    container: str
    resources: tuple[str, ...]
    holder: Holder
    left_s: float
    """What is left of the lease."""
    uses: int
    """Calls made under it."""
    last_use: float
    """``time.time()`` of the last one; 0 for none."""
    waiting: tuple[str, ...]
    """Who waits for any of it, next first."""


class Waiter(Struct, eq=False):
    """Somebody who asks for resources."""

    order: tuple[int, int]
    resources: tuple[Resource, ...]
    holder: Holder
    calls: frozenset[int]
    """Of the asking chain: they are not waited for."""
    gone: str = ""
    """Why it waits in vain."""


class Grant(Struct, eq=False):
    """Resources that somebody has, all until the same moment."""

    number: int
    resources: tuple[Resource, ...]
    holder: Holder
    lease_s: float
    until: float

    def info(self, epoch: str, container: str, now: float, waiting: Iterable[Waiter]) -> LockInfo:
        """As others see it, with those of the waiting who wait for any of it."""
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
    """Of what could not be stopped: nobody gets it before it is resumed."""
    purpose = f"could not be stopped ({resource.unsafe}); look at it, then `trade resume {resource.name}`"
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
