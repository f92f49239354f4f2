"""What the access policy lets a client do.

The system knows the door alone: it judges every call as the door's. So the door judges first, by the same policy and
with the client's name; and it offers nothing of the middleware's own functions, which would take its word for it.
"""

from collections.abc import Iterable
from typing import Final

from trade import Container, Handle
from trade.errors import AccessDenied
from trade.policies import Policy

ANONYMOUS: Final = "anonymous"
"""Who shows neither token nor certificate; let in only where the policy names it."""
_OWN: Final = "trade"
"""Group of the middleware's own functions."""
_TO_SEE: Final = ("call", "read", "lock", "instrument", "administer")
"""Any of these over a group shows what is in it."""


class ClientAuthorizer:
    """Decides by the policy that the door's container has now; without one everybody may do everything."""

    def __init__(self, container: Container) -> None:
        self._access = container.access
        self._container = container

    @property
    def governed(self) -> bool:
        """Whether there is a policy."""
        return self._access.policy is not None

    @property
    def lets_anybody_in(self) -> bool:
        """Whether the policy has given a role to those whom nobody knows, by name and not by a pattern."""
        policy = self._access.policy
        return policy is not None and ANONYMOUS in policy.names() and bool(policy.roles_of(ANONYMOUS))

    @property
    def policy(self) -> Policy | None:
        """What it goes by."""
        return self._access.policy

    def admits(self, who: str) -> bool:
        """Whether an identity may speak at all: it is not revoked."""
        policy = self._access.policy
        return policy is None or policy.authenticated(who).allowed

    def sees(self, who: str, handle: Handle) -> bool:
        """Whether an identity may know of a service. What belongs to the middleware is for no client of the door."""
        policy, group = self._access.policy, handle.key.domain
        if group == _OWN:
            return False
        return policy is None or any(policy.decide(who, verb, group).allowed for verb in _TO_SEE)

    def may_call(self, who: str, handle: Handle) -> bool:
        """Whether an identity may call a service."""
        try:
            self.require_call(who, handle)
        except AccessDenied:
            return False
        return True

    def require_call(self, who: str, handle: Handle) -> None:
        """Raises AccessDenied: it may not call that; a stop needs no right."""
        if handle.key.domain == _OWN:
            rule = "the door passes on no functions of the middleware"
            raise AccessDenied(who=who, verb="call", what=handle.label, rule=rule)
        self._container.require_call(who, handle)

    def require(self, who: str, verb: str, handles: Iterable[Handle]) -> None:
        """Raises AccessDenied: it may not do that to one of these."""
        for handle in handles:
            if handle.key.domain == _OWN:
                rule = "the door passes on no functions of the middleware"
                raise AccessDenied(who=who, verb=verb, what=handle.label, rule=rule)
            self._access.require(who, verb, handle.key.domain, handle.label)

    def require_some(self, who: str, what: str) -> None:
        """Raises AccessDenied: it may not even see anything, as who has no role; so it reads nothing of the system."""
        policy = self._access.policy
        if policy is not None and not policy.groups_of(who, _TO_SEE):
            rule = "it has no right over any group, and reads nothing of the system; a stop needs none"
            raise AccessDenied(who=who, verb="read", what=what, rule=rule)

    def require_system(self, who: str, verb: str, what: str) -> None:
        """Raises AccessDenied: it may not ``administer`` or ``read`` the system itself."""
        self._access.require(who, verb, _OWN, what)

    def may_system(self, who: str, verb: str) -> bool:
        """Whether it may."""
        return self._access.denied(who, verb, _OWN, "the system") is None
