"""What the lock table of a container keeps of each grant and of each who waits, and how others see it."""

from collections.abc import Iterable

from msgspec import Struct

from trade._protocol.messages import Token
from trade._resources.lock_request import LockInfo
from trade._resources.resource import Holder, Resource


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
