"""The access policy: which identity may do what in which groups. Pure data, compiled once and immutable."""

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from msgspec import Struct

VERBS: Final = ("call", "read", "register", "lock", "instrument", "administer")
"""The rights: call what actuates, call what reads, offer providers, lock, attach hooks, change the system."""

EVERYTHING: Final = "*"
"""In a rule: every group, and services without a group."""

_MOST_STRANGERS: Final = 4096
"""The most unnamed identities whose rights are cached; for more, rights are computed again."""


class Decision(NamedTuple):
    """Whether an identity may do something, and why."""

    allowed: bool
    rule: str
    """The deciding rule, in words."""


class Role(Struct, frozen=True):
    """The rights of one kind of identity."""

    name: str
    rights: Mapping[str, Sequence[str]]
    """Verb to groups."""
    includes: Sequence[str] = ()
    """Roles whose rights this role includes; without cycles."""


_Rights = dict[tuple[str, str], str]
"""From (verb, group as the rule names it) to the rule in words."""


class Policy:
    """Which identity may do what; denies everything that no rule allows.

    ``decide`` costs a few dictionary look-ups, whatever the size of the policy.
    """

    def __init__(
        self,
        roles: Iterable[Role],
        identities: Mapping[str, Sequence[str]],
        revoked: Iterable[str] = (),
        source: str = "policy",
        gateways: Iterable[str] = (),
        approval: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        """Compile the policy.

        Args:
            roles: all roles.
            identities: names, or patterns with ``*`` and ``?``, to the names of roles.
            revoked: identities that may do nothing any more, stopping included.
            source: the file it was read from, for messages.
            gateways: identities whose forwarded messages the transport accepts, as they have checked them.
            approval: names, or patterns, to the groups in which an agent of that name needs a person's approval.
        """
        self.source: Final = source
        self.roles: Final = {role.name: role for role in roles}
        self.identities: Final = {pattern: tuple(names) for pattern, names in identities.items()}
        self.revoked: Final = frozenset(revoked)
        self.gateways: Final = tuple(gateways)
        self.approval: Final = {pattern: tuple(groups) for pattern, groups in (approval or {}).items()}
        self._of_role = {name: self._rights_of_role(name) for name in self.roles}
        self._of: dict[str, _Rights] = {}

    # --- asking

    def decide(self, identity: str, verb: str, group: str) -> Decision:
        """Whether an identity may do something in a group.

        Args:
            identity: the identity.
            verb: one of ``VERBS``.
            group: a whole dotted group; ``_`` for what is in none.
        """
        if identity in self.revoked:
            return Decision(False, f"{identity} is revoked")
        rights = self._of.get(identity)
        if rights is None:
            rights = self._learn(identity)
        rule = rights.get((verb, EVERYTHING))
        above = group
        while rule is None and above:
            rule = rights.get((verb, above))
            above = above.rpartition(".")[0]
        if rule is None:
            return Decision(False, self._why_not(identity, verb, group))
        return Decision(True, rule)

    def authenticated(self, identity: str) -> Decision:
        """Whether an identity may do what needs no right: every one that is not revoked."""
        return (
            Decision(False, f"{identity} is revoked")
            if identity in self.revoked
            else Decision(True, "every identity may")
        )

    def asks_first(self, identity: str, group: str) -> bool:
        """Whether an agent of that name needs a person's approval for what acts in a whole dotted group."""
        marked = {
            one for name, groups in self.approval.items() if fnmatch.fnmatchcase(identity, name) for one in groups
        }
        words = group.split(".")
        return not marked.isdisjoint({EVERYTHING, *(".".join(words[:count]) for count in range(1, len(words) + 1))})

    def roles_of(self, identity: str) -> tuple[str, ...]:
        """The roles of an identity, in the order of the policy; a revoked one has none."""
        if identity in self.revoked:
            return ()
        found = (names for pattern, names in self.identities.items() if fnmatch.fnmatchcase(identity, pattern))
        return tuple(dict.fromkeys(name for names in found for name in names))

    def roles_with(self, verb: str, group: str) -> tuple[str, ...]:
        """The roles that have a verb over a whole dotted group, in the order of the policy."""
        words = group.split(".")
        covering = [EVERYTHING, *(".".join(words[:count]) for count in range(1, len(words) + 1))]
        return tuple(name for name, rights in self._of_role.items() if any((verb, one) in rights for one in covering))

    def groups_of(self, identity: str, verbs: Iterable[str]) -> list[str]:
        """The groups an identity has one of these verbs over, as the rules name them, sorted; only ``*`` if all."""
        wanted = set(verbs)
        groups = {group for verb, group in self._rights(identity) if verb in wanted}
        return [EVERYTHING] if EVERYTHING in groups else sorted(groups)

    def names(self) -> list[str]:
        """The identities that are named in full and not revoked."""
        return [name for name in self.identities if not _is_pattern(name) and name not in self.revoked]

    def patterns(self) -> list[str]:
        """The patterns that match several identities."""
        return [name for name in self.identities if _is_pattern(name)]

    # --- compiling

    def _rights(self, identity: str) -> _Rights:
        rights: _Rights = {}
        for name in self.roles_of(identity):
            for right, rule in self._of_role[name].items():
                rights.setdefault(right, rule)
        return rights

    def _learn(self, identity: str) -> _Rights:
        if len(self._of) >= _MOST_STRANGERS:
            self._of.clear()
        return self._of.setdefault(identity, self._rights(identity))

    def _rights_of_role(self, name: str) -> _Rights:
        rights: _Rights = {}
        open_, done = [name], set[str]()
        while open_:
            role = self.roles[open_.pop(0)]
            if role.name in done:
                continue
            done.add(role.name)
            open_ += role.includes
            for verb, groups in role.rights.items():
                for group in groups:
                    rights.setdefault((verb, group), f"role {role.name}: {verb} {group}")
        return rights

    def _why_not(self, identity: str, verb: str, group: str) -> str:
        roles = self.roles_of(identity)
        if not roles:
            return f"no rule gives {identity} a role"
        return f"no rule of role{'s' if len(roles) > 1 else ''} {', '.join(roles)} allows {verb} in {group}"


def _is_pattern(name: str) -> bool:
    return "*" in name or "?" in name


def different(before: Policy, after: Policy) -> list[str]:
    """The differences between two policies, in words."""
    changed = [f"{name} is revoked now" for name in sorted(after.revoked - before.revoked)]
    changed += [f"{name} is revoked no more" for name in sorted(before.revoked - after.revoked)]
    parts = ("roles", "identities", "gateways", "approval")
    others = [part for part in parts if getattr(before, part) != getattr(after, part)]
    changed += [f"other {' and '.join(others)}"] if others else []
    return changed
