"""Authorises calls, offers and locks of one container by the access policy.

Each call is checked twice, by its caller and by its provider, with the same rules. It is authorised as the identity of
the calling container. Acting on behalf of another client neither adds nor removes rights.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from trade._security.policy import Decision, Policy
from trade._security.policy_file import Seen, look_at, policy_files, read_policy
from trade.errors import AccessDenied
from trade.protocol.keys import DOMAIN, ESTOP_PROVIDER, PROVIDER, domain_of

_ALL: Final = ""
FUNCTIONS: Final = {
    "clock": _ALL,
    "containers": _ALL,
    "load": _ALL,
    "withdrawn": _ALL,
    "locks": _ALL,
    "stops": _ALL,
    "renew": _ALL,  # own ones only
    "release": _ALL,  # own ones only
    "request_release": _ALL,
    "release_requested": _ALL,
    "estop": _ALL,
    "stop_group": _ALL,
    "estops": _ALL,
    "notify": "instrument",  # and the right to make the call, checked at each call
    "notifications": _ALL,
    "cancel_notification": _ALL,  # checks administer itself for another owner's
    "detach_notification": _ALL,  # likewise
    "notification_failed": _ALL,
    "attach_hook": _ALL,  # checks instrument itself over each service
    "detach_hook": _ALL,  # checks administer itself for another owner's
    "hooks": _ALL,
    "hook_suspended": _ALL,
    "set_tracing": "instrument",
    "spans": "read",
    "network": "read",
    "stream_listeners": "read",
    "state_events": "read",
    "call_profile": "read",
    "watch_calls": "instrument",
    "log_lines": "read",
    "listen": _ALL,  # checks read itself over the service
    "unlisten": _ALL,  # own ones only
    "acquire": _ALL,  # checks lock itself over the groups of the resources
    "break_lock": _ALL,  # checks administer itself over them
    "resume": _ALL,  # checks administer itself over other owners' locks
    "migrate": _ALL,  # checks administer itself over the groups of the provider
    "save_state": _ALL,  # likewise
    "restore_state": _ALL,  # likewise
    "prepare_arrival": _ALL,  # checks register itself over the groups of the provider
    "arrive": _ALL,  # own ones only; likewise
    "arrived": _ALL,  # own ones only
    "deregister": "administer",
    "register": "administer",
    "instantiate": "administer",
    "add_code": "administer",
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
"""The verb that each of the middleware's functions needs over group ``trade``; empty: any identity not revoked."""

SOME_HAVE: Final = {
    "children": "read",
    "child_tables": "administer",
    "restart_child": "administer",
    "stop_child": "administer",
    "hand_back_child": "administer",
    "lease_child": _ALL,  # checks itself for the gateway that it replaces
    "keep_child": _ALL,  # likewise
    "rule_file": "read",
    "try_rules": "administer",  # its conditions are called with the rights of the container
    "save_rules": "administer",
}
"""The same for functions that only some containers have: those that supervise others, or run rules."""
_ALL_FUNCTIONS: Final = {**FUNCTIONS, **SOME_HAVE}
_OPEN_TO_ALL: Final = (PROVIDER, ESTOP_PROVIDER, "supervisor", "rule_file")
"""The providers of these functions: offering them needs no right, as each of their callers is checked."""

_NEEDS: Final = {"read": "read", "note": "call", "actuate": "call", "stop": _ALL}
"""The verb that other services need over their group, by effect; a stop is open to every identity (S07)."""


def verb_of(domain: str, name: str, effect: str) -> str:
    """The verb that a service requires over its group; empty: the caller only must not be revoked."""
    return _ALL_FUNCTIONS.get(name, "administer") if domain == DOMAIN else _NEEDS.get(effect, "call")


def decide_call(policy: Policy, identity: str, domain: str, name: str, effect: str) -> tuple[str, Decision]:
    """Whether an identity may call a service of a group: the verb that the call needs, and the decision."""
    verb = verb_of(domain, name, effect)
    return (verb, policy.decide(identity, verb, domain)) if verb else ("call", policy.authenticated(identity))


class Authorizer:
    """Applies the policy of one container; without a policy every identity may do everything."""

    def __init__(self, path: Path | None = None, *, certified: bool = False) -> None:
        """Read the policy; ``certified``: links prove identities. Raises ConfigurationError: the policy is wrong."""
        self._certified = certified
        self.policy: Policy | None = None
        self.path: Path | None = None
        """The file that it was read from."""
        self._files: tuple[Path, ...] = ()
        self.seen: Seen = ()
        """The state of its files before they were read."""
        if path is not None:
            self.load(path)

    def load(self, path: Path) -> None:
        """Replace the policy. Raises ConfigurationError: the new one is wrong, and the old one stays."""
        files = policy_files(path.absolute())
        seen = look_at(files)
        self.policy = read_policy(path)
        self.path, self._files, self.seen = path.absolute(), files, seen

    def look(self) -> Seen:
        """The current state of its files."""
        return look_at(self._files)

    def callers(self) -> list[str]:
        """The identities that can call; empty where identities are not proven."""
        policy = self.policy if self._certified else None
        return [] if policy is None else [*policy.names(), *policy.gateways]

    def hidden(self, identity: str, group: str) -> str:
        """Why the contents of a group are hidden from an identity, in the policy's words; empty: they are not."""
        if self.policy is None or not self._certified or group in ("", DOMAIN):
            return ""
        decision = self.policy.decide(identity, "read", group)
        return "" if decision.allowed else f"{identity} may not read {group}: {decision.rule}"

    # --- calls

    def denied_call(
        self, policy: Policy, identity: str, domain: str, name: str, effect: str, what: str
    ) -> AccessDenied | None:
        """Why an identity may not call a service; None if it may."""
        verb, decision = decide_call(policy, identity, domain, name, effect)
        return None if decision.allowed else AccessDenied(who=identity, verb=verb, what=what, rule=decision.rule)

    def require_call(self, identity: str, domain: str, name: str, effect: str, what: str) -> None:
        """Raises AccessDenied: the identity may not call the service."""
        if self.policy is not None:
            denied = self.denied_call(self.policy, identity, domain, name, effect, what)
            if denied is not None:
                raise denied

    # --- everything else

    def require(self, identity: str, verb: str, group: str, what: str) -> None:
        """Raises AccessDenied: the identity does not have the verb over the group."""
        self.require_any(identity, verb, (group,), what)

    def denied(self, identity: str, verb: str, group: str, what: str) -> AccessDenied | None:
        """Why the identity does not have the verb over the group; None if it has."""
        return self._denied_all(identity, verb, (group,), what)

    def require_any(self, identity: str, verb: str, groups: Iterable[str], what: str) -> None:
        """Raises AccessDenied: the identity has the verb over none of the groups."""
        denied = self._denied_all(identity, verb, groups, what)
        if denied is not None:
            raise denied

    def _denied_all(self, identity: str, verb: str, groups: Iterable[str], what: str) -> AccessDenied | None:
        if self.policy is None:
            return None
        rule = f"no offered service uses {what}"
        for group in sorted(groups):
            decision = self.policy.decide(identity, verb, group)
            if decision.allowed:
                return None
            rule = decision.rule
        return AccessDenied(who=identity, verb=verb, what=what, rule=rule)

    def denied_lock(self, identity: str, resources: Iterable[tuple[str, Iterable[str]]]) -> AccessDenied | None:
        """Why an identity may not lock resources, each given with the groups that use it; None if it may."""
        denials = (self._denied_all(identity, "lock", groups, name) for name, groups in resources)
        return next((denied for denied in denials if denied is not None), None)

    def denied_order(self, identity: str, *, clears: bool) -> AccessDenied | None:
        """Why an e-stop order is refused: any identity may stop, but only an administrator of the system may clear."""
        if self.policy is None:
            return None
        verb = "administer" if clears else "call"
        decision = self.policy.decide(identity, verb, DOMAIN) if clears else self.policy.authenticated(identity)
        return None if decision.allowed else AccessDenied(who=identity, verb=verb, what="estop", rule=decision.rule)

    def may_have_stops(self, identity: str) -> bool:
        """Whether an identity may offer any service: otherwise it has nothing to stop."""
        return self.policy is None or bool(self.policy.groups_of(identity, ("register",)))

    def may_offer(self, identity: str, domain: str, provider: str, groups: Sequence[str]) -> bool:
        """Whether an identity may offer what a registry entry describes: own functions, or what the policy allows."""
        if self.policy is None:
            return True
        if domain == DOMAIN and provider in _OPEN_TO_ALL and tuple(groups) == (DOMAIN,):
            return self.policy.authenticated(identity).allowed
        return all(self.policy.decide(identity, "register", group).allowed for group in (domain, *groups))

    def require_offer(self, identity: str, groups: tuple[str, ...], what: str) -> None:
        """Raises AccessDenied: the identity may not offer something in all of these groups."""
        for group in groups or (domain_of(groups),):
            self.require(identity, "register", group, f"{what} in {group}")
