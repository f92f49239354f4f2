"""The transport's own access rules, made from the policy: they pin every identity to its keys at the first hop.

docs/access-control.md has the table and how it was found. One table serves a container's own session and a gateway's:
what an identity may send to whoever holds the rules, and what it may be sent.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Final, Literal

from trade._policies import EVERYTHING, VERBS, Policy
from trade._system import DOMAIN
from trade._wire import ALIVE, ESTOPS, REGISTRY

__all__ = ["acl"]

_IN: Final = "ingress"
_OUT: Final = "egress"
_ALL_MESSAGES: Final = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)
_SEEING: Final = tuple(verb for verb in VERBS if verb != "register")
"""Who may do one of these in a group may know what is offered there."""

_BEHIND: Final = {
    "id": "calls behind",
    "flows": [_IN],
    "messages": ["put"],
    "overwrite": {"priority": "data_low", "express": False},
}

_Row = tuple[str, str, Sequence[str]]
"""Flow, message, keys."""


def acl(
    policy: Policy,
    *,
    namespace: str,
    identities: Iterable[str] | None = None,
    gateways: Sequence[str] = (),
    subject: Literal["cert_common_names", "usernames"] = "cert_common_names",
    calls_hz: float | None = None,
) -> dict[str, Any]:
    """Settings of a zenoh session that let each identity send and hear what the policy allows, and nothing else.

    Args:
        policy: who may what.
        namespace: the system id: rules go by the keys on the wire, which begin with it.
        identities: everybody there is; by default those the policy names in full, as rules know no patterns.
        gateways: identities that are believed whatever they pass on, as they have checked it themselves. Nobody else
            may ever be given such a name.
        subject: what tells who is at the other end of a link; user names are known to the end that was dialled only.
        calls_hz: how often an identity may call at most, evenly spread: of two calls that come closer together than
            that the second is dropped. None: as often as it likes.

    Returns:
        ``access_control``, ``downsampling`` and ``qos/network``, as zenoh names them. They are read when a session
        opens: another policy needs another session. The last one sends calls on behind everything else, so that who
        floods with them holds up nobody's stops and answers.
    """
    known = [name for name in (policy.names() if identities is None else identities) if name not in policy.revoked]
    tables = {name: _rows(policy, name) for name in dict.fromkeys(known) if name not in gateways}
    tables.update((name, _trusted()) for name in gateways if name not in policy.revoked)
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for name, rows in tables.items():
        made = [_rule(f"{name} {flow} {message}", flow, message, keys, namespace) for flow, message, keys in rows]
        rules += made
        policies.append({"rules": [rule["id"] for rule in made], "subjects": [name]})
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": name, subject: [name]} for name in tables],
            "policies": policies,
        },
        "qos/network": [_BEHIND | {"key_exprs": [f"{namespace}/call/**"]}],
        "downsampling": [] if calls_hz is None else _limits(tables.keys() - set(gateways), namespace, calls_hz),
    }


def _rows(policy: Policy, me: str) -> list[_Row]:
    """What one identity may send to us, and what we may send to it."""
    calls = _over(policy, me, ("call", "read"), f"call/{me}/*/*/*/{{}}/*")
    offers = _over(policy, me, ("register",), f"registry/{{}}/{me}/*/*/*")
    sees = _over(policy, me, _SEEING, "registry/{}/*/*/*/*")
    own = f"registry/*/{me}/*/*/*"
    to_it = [f"call/*/{me}/**", f"stop/*/{me}/**", f"reply/*/{me}/**", ESTOPS]
    return [
        (_IN, "put", [*calls, f"stop/{me}/**", f"reply/{me}/**", *offers, f"estop/{me}/**"]),
        (_IN, "reply", offers),
        (_IN, "query", [REGISTRY]),
        (_IN, "declare_subscriber", [REGISTRY, *to_it]),
        (_IN, "declare_queryable", [own]),
        (_IN, "liveliness_token", [f"alive/{me}/**"]),
        (_IN, "declare_liveliness_subscriber", [ALIVE]),
        (_IN, "liveliness_query", [ALIVE]),
        (_OUT, "put", [*sees, *to_it]),
        (_OUT, "reply", sees),
        (_OUT, "query", [REGISTRY]),
        (_OUT, "declare_subscriber", [REGISTRY, "call/**", "stop/**", "reply/**", ESTOPS]),
        (_OUT, "declare_queryable", [REGISTRY]),
        (_OUT, "liveliness_token", [ALIVE]),
    ]


def _over(policy: Policy, who: str, verbs: Iterable[str], pattern: str) -> list[str]:
    """Keys of the groups an identity has one of the verbs over, and of the middleware's own."""
    groups = policy.groups_of(who, verbs)
    if groups == [EVERYTHING]:
        return [pattern.format("*")]
    own = [DOMAIN] if DOMAIN not in groups else []
    beneath = [chunk for group in groups for chunk in (group, f"{group}.$*")]
    return [pattern.format(chunk) for chunk in (*own, *beneath)]


def _trusted() -> list[_Row]:
    return [(flow, message, ["**"]) for flow in (_IN, _OUT) for message in _ALL_MESSAGES]


def _rule(name: str, flow: str, message: str, keys: Sequence[str], namespace: str) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": [message],
        "key_exprs": [f"{namespace}/{key}" for key in keys],
    }


def _limits(identities: Iterable[str], namespace: str, calls_hz: float) -> list[dict[str, Any]]:
    """One rule is one clock, of one link: so one for each identity."""
    rules = [{"key_expr": f"{namespace}/call/{name}/**", "freq": calls_hz} for name in sorted(identities)]
    return [{"id": "calls", "flows": [_IN], "messages": ["put"], "rules": rules}] if rules else []
