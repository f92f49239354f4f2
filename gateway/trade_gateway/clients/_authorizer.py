"""Authorisation of clients by the access policy.

The system authorises every call as the HTTP gateway's own identity. So the gateway first authorises the client, by the
same policy; and it offers no service of the middleware itself, as those would accept the gateway's identity.
"""

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Final

from trade import Container, Handle, where
from trade.errors import AccessDenied
from trade.policies import Policy
from trade_gateway.clients._clients import places
from trade_gateway.clients._errors import NeedsApproval

ANONYMOUS: Final = "anonymous"
"""Identity of clients without a token or certificate; admitted only if the policy names it."""
_OWN: Final = "trade"
"""Group of the middleware's own services."""
_TO_SEE: Final = ("call", "read", "lock", "instrument", "administer")
"""Any of these rights over a group makes its services visible."""


class ClientAuthorizer:
    """Decides by the current policy of the container; without one everything is allowed."""

    def __init__(self, container: Container) -> None:
        self._access = container.access
        self._container = container

    @property
    def governed(self) -> bool:
        """Whether there is a policy."""
        return self._access.policy is not None

    @property
    def lets_anybody_in(self) -> bool:
        """Whether the policy has a role for unidentified clients, by name and not by a pattern."""
        policy = self._access.policy
        return policy is not None and ANONYMOUS in policy.names() and bool(policy.roles_of(ANONYMOUS))

    @property
    def policy(self) -> Policy | None:
        """The current policy."""
        return self._access.policy

    @property
    def policy_path(self) -> Path | None:
        """The file of the current policy."""
        return self._access.path

    def admits(self, identity: str) -> bool:
        """Whether an identity is admitted at all: it is not revoked."""
        policy = self._access.policy
        return policy is None or policy.authenticated(identity).allowed

    def sees(self, identity: str, handle: Handle) -> bool:
        """Whether an identity may know of a service. No client may know of the middleware's own services."""
        policy, group = self._access.policy, handle.key.domain
        if group == _OWN:
            return False
        return policy is None or any(policy.decide(identity, verb, group).allowed for verb in _TO_SEE)

    def may_call(self, identity: str, handle: Handle) -> bool:
        """Whether an identity may call a service."""
        try:
            self.require_call(identity, handle)
        except AccessDenied:
            return False
        return True

    def require_call(self, identity: str, handle: Handle) -> None:
        """Raises AccessDenied: the identity may not call the service; a stop needs no right."""
        if handle.key.domain == _OWN:
            rule = "the HTTP gateway forwards no calls to the middleware's own services"
            raise AccessDenied(who=identity, verb="call", what=handle.label, rule=rule)
        self._container.client.require_call(identity, handle)

    def needs_approval(self, identity: str, handle: Handle, ask_first: Collection[str] = ()) -> bool:
        """Whether a call of an identity needs a person's approval, by the policy or because its group is listed.

        Calls that move a marked group need it whichever service moves it: the head also as two joints of the neck.
        """
        if handle.effect in ("read", "stop") or not (ask_first or (self.policy and self.policy.approval)):
            return False

        def is_marked(one: Handle) -> bool:
            return any(
                self._marks(identity, group, ask_first) for group in dict.fromkeys((one.key.domain, *one.groups))
            )

        if is_marked(handle):
            return True
        own = places([handle])
        others = (one for one in self._container.services(where()) if one.effect == "actuate")
        return any(not own.isdisjoint(places([one])) and is_marked(one) for one in others)

    def _marks(self, identity: str, domain: str, ask_first: Collection[str]) -> bool:
        if any(domain == group or domain.startswith(f"{group}.") for group in ask_first):
            return True
        return self.policy is not None and self.policy.asks_first(identity, domain)

    def require_unmarked(self, identity: str, handle: Handle) -> None:
        """Raises NeedsApproval: the policy lets the identity call the service only after an approval."""
        if self.needs_approval(identity, handle):
            raise NeedsApproval(service=handle.label, reason="only its calls over MCP can wait for one")

    def require(self, identity: str, verb: str, handles: Iterable[Handle]) -> None:
        """Raises AccessDenied: the identity lacks the right over one of these services."""
        for handle in handles:
            if handle.key.domain == _OWN:
                rule = "the HTTP gateway forwards no calls to the middleware's own services"
                raise AccessDenied(who=identity, verb=verb, what=handle.label, rule=rule)
            self._access.require(identity, verb, handle.key.domain, handle.label)

    def require_groups(self, identity: str, verb: str, handle: Handle) -> None:
        """Raises AccessDenied: the identity lacks the right over one of the groups of a service."""
        for group in handle.groups or (handle.key.domain,):
            self._access.require(identity, verb, group, handle.label)

    def require_some(self, identity: str, what: str) -> None:
        """Raises AccessDenied: the identity has no role, so it may read nothing of the system."""
        policy = self._access.policy
        if policy is not None and not policy.groups_of(identity, _TO_SEE):
            rule = "it has no right over any group, so it may read nothing of the system; a stop needs no right"
            raise AccessDenied(who=identity, verb="read", what=what, rule=rule)

    def require_system(self, identity: str, verb: str, what: str) -> None:
        """Raises AccessDenied: the identity may not ``administer`` or ``read`` the system itself."""
        self._access.require(identity, verb, _OWN, what)

    def may_system(self, identity: str, verb: str) -> bool:
        """Whether the identity may."""
        return self._access.denied(identity, verb, _OWN, "the system") is None

    def groups_of(self, identity: str, verb: str) -> tuple[str, ...]:
        """The groups over which the identity has a right, as the policy names them; only ``*`` if all."""
        policy = self._access.policy
        return ("*",) if policy is None else tuple(policy.groups_of(identity, (verb,)))
