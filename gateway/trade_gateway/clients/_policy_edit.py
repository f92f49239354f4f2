"""What a changed policy would do: the rights that identities gain and lose, and whom it would lock out."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from trade.errors import ConfigurationError
from trade.policies import VERBS, Policy, read_policy


def require_not_locked_out(policy: Policy, path: Path, editors: Iterable[str]) -> None:
    """Raises ConfigurationError: one of those who change policies here could not undo this change."""
    for who in editors:
        decision = policy.decide(who, "administer", "trade")
        if not decision.allowed:
            problem = (
                f"{who} would no longer administer the system ({decision.rule}), and could not undo this change here"
            )
            raise ConfigurationError(where=str(path), problem=problem)


def checked(path: Path, text: str, editors: Iterable[str]) -> Policy:
    """Reads a changed policy. Raises ConfigurationError: it is wrong, or locks an editor out."""
    policy = read_policy(path, text)
    require_not_locked_out(policy, path, editors)
    return policy


def changes(before: Policy, after: Policy) -> list[str]:
    """Returns the differences of rights, one in each sentence."""
    found: list[str] = []
    for who in sorted({*before.identities, *after.identities}):
        for verb in VERBS:
            was, now = (set(policy.groups_of(who, (verb,))) for policy in (before, after))
            found += _changed(who, f"may {verb}", now - was)
            found += _changed(who, f"may no longer {verb}", was - now)
    found += [f"{who} is revoked." for who in sorted(after.revoked - before.revoked)]
    found += [f"{who} is no longer revoked." for who in sorted(before.revoked - after.revoked)]
    found += _changed("Gateways now:", "", after.gateways if after.gateways != before.gateways else ())
    if _sorted(after.approval) != _sorted(before.approval):
        found.append("Other calls need a person's approval.")
    return found


def _changed(identity: str, may: str, groups: Iterable[str]) -> list[str]:
    named = ", ".join(sorted(groups))
    return [f"{identity} {may} {named}.".replace("  ", " ")] if named else []


def _sorted(approval: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    return {who: sorted(groups) for who, groups in approval.items()}
