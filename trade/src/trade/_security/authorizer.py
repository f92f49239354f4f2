"""What the access policy means for one container: who may call, offer and lock here, and what it may do elsewhere.

A call is judged twice, by whoever makes it and by whoever serves it, and by the same rules. It is made, and judged, as
the identity of the container that makes it; for whom that one acts gives it no rights and takes none away.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from trade._protocol.keys import DOMAIN, ESTOP_PROVIDER, PROVIDER, domain_of
from trade._security.policy import Decision, Policy
from trade._security.policy_file import Seen, look_at, policy_files, read_policy
from trade.errors import AccessDenied

_ALL: Final = ""
FUNCTIONS: Final = {
    "clock": _ALL,
    "containers": _ALL,
    "load": _ALL,
    "withdrawn": _ALL,
    "locks": _ALL,
    "renew": _ALL,  # only what is one's own
    "release": _ALL,  # only what is one's own
    "request_release": _ALL,
    "release_requested": _ALL,
    "estop": _ALL,
    "estops": _ALL,
    "notify": "instrument",  # and the right to make the call, looked at whenever it is made
    "notifications": _ALL,
    "cancel_notification": _ALL,  # asks itself for administer if it is another's
    "detach_notification": _ALL,  # likewise
    "notification_failed": _ALL,
    "attach_hook": _ALL,  # asks itself for instrument over each service
    "detach_hook": _ALL,  # asks itself for administer if it is another's
    "hooks": _ALL,
    "hook_suspended": _ALL,
    "set_tracing": "instrument",
    "spans": "read",
    "log_lines": "read",
    "listen": _ALL,  # asks itself for read over the service
    "unlisten": _ALL,  # only what is one's own
    "acquire": _ALL,  # asks itself for lock over the groups of the resources
    "break_lock": _ALL,  # asks itself for administer over them
    "resume": _ALL,  # asks itself for administer over those whose lock is not one's own
    "migrate": _ALL,  # asks itself for administer over the groups of the provider
    "save_state": _ALL,  # likewise
    "restore_state": _ALL,  # likewise
    "prepare_arrival": _ALL,  # asks itself for register over the groups of the provider
    "arrive": _ALL,  # only what is one's own; likewise
    "arrived": _ALL,  # only what is one's own
    "deregister": "administer",
    "register": "administer",
    "instantiate": "administer",
    "start_container": "administer",
    "terminate": "administer",
    "terminate_container": "administer",
    "set_discovery": "administer",
    "set_broadcast": "administer",
    "connect": "administer",
    "disconnect": "administer",
    "load_policy": "administer",
    "estop_clear": "administer",
}
"""What the middleware's own functions need over group ``trade``; empty: open to everybody who is not revoked."""

SOME_HAVE: Final = {
    "children": "read",
    "restart_child": "administer",
    "hand_back_child": "administer",
    "lease_child": _ALL,  # asks itself for the gateway that is stood in for
    "keep_child": _ALL,  # likewise
}
"""Likewise, of functions that only a container has which looks after others."""
_ALL_FUNCTIONS: Final = {**FUNCTIONS, **SOME_HAVE}
_OF_EVERYBODY: Final = (PROVIDER, ESTOP_PROVIDER, "supervisor")
"""The providers of these functions: who offers them needs no right, as whoever calls them is asked for one."""

_NEEDS: Final = {"read": "read", "note": "call", "actuate": "call", "stop": _ALL}
"""What other services need over their group, by effect; a stop is open to everybody (S07)."""


def verb_of(domain: str, name: str, effect: str) -> str:
    """What a service of a group asks of its callers over that group; empty: nothing but not to be revoked."""
    return _ALL_FUNCTIONS.get(name, "administer") if domain == DOMAIN else _NEEDS.get(effect, "call")


def decide_call(policy: Policy, who: str, domain: str, name: str, effect: str) -> tuple[str, Decision]:
    """Whether somebody may call a service of a group. Returns the verb that it needs, and the decision."""
    verb = verb_of(domain, name, effect)
    return (verb, policy.decide(who, verb, domain)) if verb else ("call", policy.authenticated(who))


class Authorizer:
    """The policy a container goes by; without one everybody may do everything."""

    def __init__(self, path: Path | None = None, *, certified: bool = False) -> None:
        """Read the policy; ``certified``: links tell who is who. Raises ConfigurationError: it is wrong."""
        self._certified = certified
        self.policy: Policy | None = None
        self.path: Path | None = None
        """Where it was read from."""
        self._files: tuple[Path, ...] = ()
        self.seen: Seen = ()
        """What its files were like before they were read."""
        if path is not None:
            self.load(path)

    def load(self, path: Path) -> None:
        """Go by another one from now on. Raises ConfigurationError: it is wrong, and the old one stays."""
        files = policy_files(path.absolute())
        seen = look_at(files)
        self.policy = read_policy(path)
        self.path, self._files, self.seen = path.absolute(), files, seen

    def look(self) -> Seen:
        """What its files are like now."""
        return look_at(self._files)

    def callers(self) -> list[str]:
        """Who can call, one by one; nobody where that cannot be told."""
        policy = self.policy if self._certified else None
        return [] if policy is None else [*policy.names(), *policy.gateways]

    def hidden(self, who: str, group: str) -> str:
        """Why it is not told what there is in a group, in words of the policy; empty: it is, as far as is known."""
        if self.policy is None or not self._certified or group in ("", DOMAIN):
            return ""
        decision = self.policy.decide(who, "read", group)
        return "" if decision.allowed else f"{who} may not read {group}: {decision.rule}"

    # --- calls

    def denied_call(
        self, policy: Policy, who: str, domain: str, name: str, effect: str, what: str
    ) -> AccessDenied | None:
        """Why somebody may not call a service; None if it may."""
        verb, decision = decide_call(policy, who, domain, name, effect)
        return None if decision.allowed else AccessDenied(who=who, verb=verb, what=what, rule=decision.rule)

    def require_call(self, who: str, domain: str, name: str, effect: str, what: str) -> None:
        """Raises AccessDenied: it may not call the service."""
        if self.policy is not None:
            denied = self.denied_call(self.policy, who, domain, name, effect, what)
            if denied is not None:
                raise denied

    # --- everything else

    def require(self, who: str, verb: str, group: str, what: str) -> None:
        """Raises AccessDenied: it may not do that in the group."""
        self.require_any(who, verb, (group,), what)

    def denied(self, who: str, verb: str, group: str, what: str) -> AccessDenied | None:
        """Why it may not do that in the group; None if it may."""
        return self._denied_all(who, verb, (group,), what)

    def require_any(self, who: str, verb: str, groups: Iterable[str], what: str) -> None:
        """Raises AccessDenied: it may do that in none of the groups."""
        denied = self._denied_all(who, verb, groups, what)
        if denied is not None:
            raise denied

    def _denied_all(self, who: str, verb: str, groups: Iterable[str], what: str) -> AccessDenied | None:
        if self.policy is None:
            return None
        rule = f"nothing that is offered uses {what}"
        for group in sorted(groups):
            decision = self.policy.decide(who, verb, group)
            if decision.allowed:
                return None
            rule = decision.rule
        return AccessDenied(who=who, verb=verb, what=what, rule=rule)

    def denied_lock(self, who: str, resources: Iterable[tuple[str, Iterable[str]]]) -> AccessDenied | None:
        """Why somebody may not lock these, told with the groups of the services that use each; None if it may."""
        denials = (self._denied_all(who, "lock", groups, name) for name, groups in resources)
        return next((denied for denied in denials if denied is not None), None)

    def denied_order(self, who: str, *, clears: bool) -> AccessDenied | None:
        """Why an e-stop order is not heeded: everybody may stop, and who clears has to administer the system."""
        if self.policy is None:
            return None
        verb = "administer" if clears else "call"
        decision = self.policy.decide(who, verb, DOMAIN) if clears else self.policy.authenticated(who)
        return None if decision.allowed else AccessDenied(who=who, verb=verb, what="estop", rule=decision.rule)

    def may_have_stops(self, who: str) -> bool:
        """Whether an identity may offer anything at all: else it has nothing to stop."""
        return self.policy is None or bool(self.policy.groups_of(who, ("register",)))

    def may_offer(self, who: str, domain: str, provider: str, groups: Sequence[str]) -> bool:
        """Whether an identity may have offered what a registry entry tells of: its own functions, and what it may."""
        if self.policy is None:
            return True
        if domain == DOMAIN and provider in _OF_EVERYBODY and tuple(groups) == (DOMAIN,):
            return self.policy.authenticated(who).allowed
        return all(self.policy.decide(who, "register", group).allowed for group in (domain, *groups))

    def require_offer(self, who: str, groups: tuple[str, ...], what: str) -> None:
        """Raises AccessDenied: it may not offer something in all of these groups."""
        for group in groups or (domain_of(groups),):
            self.require(who, "register", group, f"{what} in {group}")
