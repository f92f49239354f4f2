"""The service that a hook or a guard calls: a handle, or the only service that matches a constraint at that time."""

from typing import Final, cast

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._registry.constraints import Constraint, as_constraint, service_at
from trade._registry.registry import Record


class Callee:
    """Which service to call. With a constraint, it follows the service to another container, and over a restart."""

    def __init__(self, which: Handle | Constraint) -> None:
        self.handle: Final = which if isinstance(which, Handle) else None
        self.constraint: Final = None if isinstance(which, Handle) else which
        self.text: Final = which.label if isinstance(which, Handle) else f"the service with {which}"
        """The service as text."""

    def now(self, client: CallClient) -> Handle | None:
        """The service as it is now; None if no service matches. Raises TooManyServices."""
        if self.constraint is None:
            return self.handle
        found = client.services(self.constraint)
        return found[0] if len(found) == 1 else client.find(self.constraint, wait_s=0) if found else None

    def follows(self, record: Record) -> bool:
        """Whether it may be this service, which has just joined."""
        return self.constraint is not None and self.constraint.matches(record)


def callee_of(which: object, function: str) -> Callee:
    """A callee from a handle, a constraint or a text such as ``eye.see``. Raises ConfigurationError."""
    if isinstance(which, Handle):
        return Callee(cast("Handle", which))
    return Callee(as_constraint(which, function, service_at))
