"""What a provider may know of the call it serves: who asks, until when, on whose behalf."""

import time
from contextvars import ContextVar

from msgspec import Struct

__all__ = ["CallContext", "current_call"]


class CallContext(Struct, frozen=True, gc=False):
    """One call, seen from inside the service."""

    id: int
    """Unique in the system."""
    service: str
    caller: str
    """Identity of who asks."""
    session: str
    """The client's presence on whose behalf this runs; motion belongs to it."""
    expires_ns: int | None
    """``time.monotonic_ns()`` of this process after which nothing may begin; None if being late is harmless."""
    chain: tuple[str, ...] = ()
    """Services whose calls led to this one, outermost first."""

    @property
    def remaining_s(self) -> float | None:
        """Seconds until it expires, never below zero; None if it does not."""
        return None if self.expires_ns is None else max(0.0, (self.expires_ns - time.monotonic_ns()) / 1e9)


running: ContextVar[CallContext | None] = ContextVar("trade_call", default=None)


def current_call() -> CallContext | None:
    """The call the running code serves, or None outside of one (also in a plain call of the method)."""
    return running.get()
