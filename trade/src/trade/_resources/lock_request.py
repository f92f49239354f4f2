"""What is said about locks: how one is wanted, what was granted, who has what."""

from msgspec import Struct

from trade._protocol.messages import Token
from trade._resources.resource import Holder


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
