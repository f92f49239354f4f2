"""The transport's access rules, generated from the policy: the first hop limits every identity to its keys.

docs/access-control.md has the table and its derivation. One table serves a container's own session and a gateway's:
what an identity may send to the session with the rules, and what it may receive.
"""

from collections.abc import Iterable, Mapping, Sequence
from math import inf
from typing import Any, Final, Literal

from trade._security.network_crossings import Crossing
from trade._security.policy import EVERYTHING, VERBS, Policy
from trade.protocol.keys import ALIVE, DOMAIN, ESTOPS, REGISTRY
from trade.protocol.samples import STEPS_HZ, STREAMS

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
"""An identity with one of these verbs over a group may see the services of that group."""

_BEHIND: Final = {
    "id": "calls behind",
    "flows": [_IN],
    "messages": ["put"],
    "overwrite": {"priority": "data_low", "express": False},
}

_UNIDENTIFIED: Final = "*"
"""In place of an identity where peers are not identified: on links without certificates."""


_EVERYTHING_CROSSES: Final = Crossing((EVERYTHING,), (EVERYTHING,))

_SLOWER: Final = "0.$*"
"""All rates below 1 Hz, as keys name them."""

_Row = tuple[str, str, Sequence[str]]
"""Flow, message, keys."""


def acl(
    policy: Policy | None,
    *,
    namespace: str,
    identities: Iterable[str] | None = None,
    networks: Mapping[tuple[str, ...], Crossing] | None = None,
    subject: Literal["cert_common_names", "usernames"] = "cert_common_names",
    calls_hz: float | None = None,
) -> dict[str, Any]:
    """Settings of a zenoh session that let each identity send and receive what the policy allows, and nothing else.

    Args:
        policy: the rights; None: every identity may do everything that crosses, as identities are not distinguished.
        namespace: the system id; the rules match the keys on the wire, which begin with it.
        identities: all identities; by default those the policy names in full, as rules know no patterns.
        networks: of a gateway, what crosses at the interfaces of each of its networks; none: everything.
        subject: what identifies the other end of a link; only the end that was dialled knows user names.
        calls_hz: the highest rate of calls of an identity, evenly spread: of two calls that are closer together, the
            second is dropped. None: no limit.

    Returns:
        ``access_control``, ``downsampling`` and ``qos/network``, in zenoh's names. They are read when a session opens:
        another policy needs another session. The last one gives calls the lowest priority, so that a flood of them
        delays no stops and answers.
    """
    places = networks or {(): _EVERYTHING_CROSSES}
    if policy is None:
        known, gateways = [_UNIDENTIFIED], list[str]()
    else:
        gateways = [name for name in policy.gateways if name not in policy.revoked]
        named = policy.names() if identities is None else identities
        known = [name for name in dict.fromkeys(named) if name not in policy.revoked and name not in gateways]
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def let(name: str, interfaces: Sequence[str], rows: Iterable[_Row]) -> None:
        who = " ".join((name, *interfaces))
        made = [_rule(who, *row, namespace) for row in rows if row[2]]
        identified: dict[str, Any] = {} if name == _UNIDENTIFIED else {subject: [name]}
        subjects.append({"id": who, **identified, **({"interfaces": list(interfaces)} if interfaces else {})})
        rules.extend(made)
        policies.append({"rules": [rule["id"] for rule in made], "subjects": [who]})

    for interfaces, crossing in places.items():
        for name in known:
            let(name, interfaces, _rows(policy, name, crossing))
    for name in gateways:
        let(name, (), _trusted())
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        },
        "qos/network": [_BEHIND | {"key_exprs": [f"{namespace}/call/**"]}],
        "downsampling": [] if calls_hz is None else _limits(known, namespace, calls_hz),
    }


def _rows(policy: Policy | None, me: str, crossing: Crossing) -> list[_Row]:
    """What one identity may send to this session, and what this session may send to it."""
    calls = _over(policy, me, ("call", "read"), crossing.seen, f"call/{me}/*/*/*/{{}}/*")
    offers = _over(policy, me, ("register",), crossing.offered, f"registry/{{}}/{me}/*/*/*")
    sees = _over(policy, me, _SEEING, crossing.seen, "registry/{}/*/*/*/*")
    puts = _paced(policy, me, "register", crossing.offered, crossing.offered_hz, f"stream/{{}}/{me}/*/*/*/*")
    hears = _paced(policy, me, "read", crossing.seen, crossing.seen_hz, "stream/{}/*/*/*/*/*")
    own = f"registry/*/{me}/*/*/*"
    to_it = [f"call/*/{me}/**", f"stop/*/{me}/**", f"reply/*/{me}/**", ESTOPS]
    return [
        (_IN, "put", [*calls, f"stop/{me}/**", f"reply/{me}/**", *offers, *puts, f"estop/{me}/**"]),
        (_IN, "reply", offers),
        (_IN, "query", [REGISTRY]),
        (_IN, "declare_subscriber", [REGISTRY, *to_it, *hears]),
        (_IN, "declare_queryable", [own]),
        (_IN, "liveliness_token", [f"alive/{me}/**", *puts]),
        (_IN, "declare_liveliness_subscriber", [ALIVE]),
        (_IN, "liveliness_query", [ALIVE, STREAMS]),
        (_OUT, "put", [*sees, *to_it, *hears]),
        (_OUT, "reply", sees),
        (_OUT, "query", [REGISTRY]),
        (_OUT, "declare_subscriber", [REGISTRY, "call/**", "stop/**", "reply/**", STREAMS, ESTOPS]),
        (_OUT, "declare_queryable", [REGISTRY]),
        (_OUT, "liveliness_token", [ALIVE, *hears]),
    ]


def _over(policy: Policy | None, identity: str, verbs: Iterable[str], among: Sequence[str], pattern: str) -> list[str]:
    """Keys of those of some groups over which an identity has one of the verbs, and of the middleware's own."""
    groups = _both([EVERYTHING] if policy is None else policy.groups_of(identity, verbs), among)
    if groups == [EVERYTHING]:
        return [pattern.format("*")]
    own = [DOMAIN] if DOMAIN not in groups else []
    beneath = [chunk for group in groups for chunk in (group, f"{group}.$*")]
    return [pattern.format(chunk) for chunk in (*own, *beneath)]


def _paced(
    policy: Policy | None,
    identity: str,
    verb: str,
    among: Sequence[str],
    limits: Mapping[str, float],
    pattern: str,
) -> list[str]:
    """Keys of the streams of these groups; of limited ones only at those rates."""
    keys: list[str] = []
    for limit in sorted({limits.get(group, inf) for group in among} or {inf}):
        groups = [group for group in among if limits.get(group, inf) == limit]
        rates = ["*"] if limit == inf else [_SLOWER, *(str(step) for step in STEPS_HZ if step <= limit)]
        keys += [f"{key}/{rate}" for key in _over(policy, identity, (verb,), groups, pattern) for rate in rates]
    return list(dict.fromkeys(keys))


def _both(some: Sequence[str], others: Sequence[str]) -> list[str]:
    """The groups that both lists name, where each group includes all beneath it."""
    return sorted({narrow for one in some for other in others if (narrow := _narrower(one, other))})


def _narrower(one: str, other: str) -> str:
    if other in (EVERYTHING, one) or one.startswith(f"{other}."):
        return one
    return other if one == EVERYTHING or other.startswith(f"{one}.") else ""


def _trusted() -> list[_Row]:
    return [(flow, message, ["**"]) for flow in (_IN, _OUT) for message in _ALL_MESSAGES]


def _rule(identity: str, flow: str, message: str, keys: Sequence[str], namespace: str) -> dict[str, Any]:
    return {
        "id": f"{identity} {flow} {message}",
        "permission": "allow",
        "flows": [flow],
        "messages": [message],
        "key_exprs": [f"{namespace}/{key}" for key in keys],
    }


def _limits(identities: Iterable[str], namespace: str, calls_hz: float) -> list[dict[str, Any]]:
    """One rule is one clock for one link: hence one rule for each identity."""
    rules = [{"key_expr": f"{namespace}/call/{name}/**", "freq": calls_hz} for name in sorted(identities)]
    return [{"id": "calls", "flows": [_IN], "messages": ["put"], "rules": rules}] if rules else []
