"""What a policy allows, and what is said of a policy that is wrong."""

import fnmatch
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade._security.policy import VERBS, Policy, Role
from trade._security.policy_file import read_policy
from trade.errors import ConfigurationError

pytestmark = pytest.mark.virtual_time

POLICY = """
revoked = ["mallory"]

[roles.viewer]
read = ["*"]

[roles.operator]
includes = ["viewer"]
call = ["rosie.neck", "rosie.head"]
lock = ["rosie"]

[roles.driver]
register = ["rosie"]

[identities]
planner = ["operator"]
mallory = ["operator"]
"drv-*" = ["driver", "viewer"]
"""


@pytest.fixture
def policy(tmp_path: Path) -> Policy:
    return read_policy(written(tmp_path, POLICY))


def written(folder: Path, text: str, name: str = "policy.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


DECISIONS = [
    ("planner", "call", "rosie.neck", True),
    ("planner", "call", "rosie.neck.pan", True),
    ("planner", "call", "rosie", False),
    ("planner", "call", "rosie.necklace", False),
    ("planner", "lock", "rosie.neck", True),
    ("planner", "read", "other", True),
    ("planner", "read", "_", True),
    ("planner", "register", "rosie.neck", False),
    ("drv-1", "register", "rosie.arm", True),
    ("drv-1", "call", "rosie.arm", False),
    ("drv", "register", "rosie.arm", False),
    ("stranger", "read", "rosie", False),
    ("mallory", "read", "rosie", False),
]


@pytest.mark.parametrize(("who", "verb", "group", "allowed"), DECISIONS)
def test_what_no_rule_allows_is_denied(policy: Policy, who: str, verb: str, group: str, allowed: bool) -> None:
    assert policy.decide(who, verb, group).allowed is allowed


def test_a_decision_names_the_rule(policy: Policy) -> None:
    assert policy.decide("planner", "call", "rosie.neck.pan").rule == "role operator: call rosie.neck"
    assert policy.decide("planner", "read", "x").rule == "role viewer: read *"
    assert policy.decide("planner", "call", "x").rule == "no rule of role operator allows call in x"
    assert policy.decide("drv-1", "call", "x").rule == "no rule of roles driver, viewer allows call in x"
    assert policy.decide("stranger", "read", "x").rule == "no rule gives stranger a role"
    assert policy.decide("mallory", "read", "x").rule == "mallory is revoked"


def test_rights_of_everyone_do_not_include_revoked_identities(policy: Policy) -> None:
    assert policy.authenticated("stranger").allowed
    assert not policy.authenticated("mallory").allowed


def test_the_groups_of_an_identity_are_those_of_its_rules(policy: Policy) -> None:
    assert policy.groups_of("planner", ("call", "lock")) == ["rosie", "rosie.head", "rosie.neck"]
    assert policy.groups_of("planner", VERBS) == ["*"]
    assert policy.groups_of("mallory", VERBS) == []
    assert policy.names() == ["planner"]


def test_revoked_identities_are_read_from_the_file_beside_it(tmp_path: Path) -> None:
    written(tmp_path, 'revoked = ["planner"]', "revoked.toml")
    policy = read_policy(written(tmp_path, 'revoked_file = "revoked.toml"\n' + POLICY))
    assert not policy.decide("planner", "read", "rosie").allowed
    assert not policy.decide("mallory", "read", "rosie").allowed
    assert policy.decide("drv-1", "read", "rosie").allowed


ROLE = "[roles.a]\n{}\n[identities]\nplanner = ['a']\n"
WRONG = {
    "no TOML": ("[roles", "not valid TOML"),
    "no roles": ("[identities]\n", r"\[roles\]: missing; write \[roles.operator\]"),
    "no identities": ("[roles]\n", r"\[identities\]: missing; write \[identities\]"),
    "unknown key": ("role = 1\n", r"policy.toml: role: unknown key; did you mean roles\?"),
    "unknown verb": (ROLE.format("calls = ['x']"), r"roles.a: calls: unknown key; did you mean call\?"),
    "role no table": ("[roles]\na = 1\n[identities]\n", r"roles.a: must be a table: \[roles.a\]"),
    "identities no table": ("identities = 1\n[roles]\n", r"identities: must be a table: \[identities\]"),
    "groups no list": (ROLE.format("call = 'x'"), r"roles.a.call: must be a list of texts, such as .*rosie.neck"),
    "no group": (ROLE.format("call = ['rosie.*']"), r"roles.a.call: 'rosie.\*' is no group; write rosie.neck"),
    "unknown role": ("[roles.view]\n[identities]\np = ['viev']\n", r"there is no role 'viev'; did you mean view\?"),
    "unknown include": (ROLE.format("includes = ['b']"), r"roles.a.includes: there is no role 'b'; there is a"),
    "includes itself": (ROLE.format("includes = ['a']"), r"includes: a role cannot include itself: a -> a; leave"),
    "cycle": (
        ROLE.format("includes = ['b']\n[roles.b]\nincludes = ['c']\n[roles.c]\nincludes = ['b']"),
        r"roles.b.includes: a role cannot include itself: b -> c -> b",
    ),
    "no identity": ("[roles.a]\n[identities]\n'a/b' = ['a']\n", r"identities: 'a/b' is no identity"),
    "revoked pattern": ("revoked = ['a*']\n" + ROLE.format(""), r"revoked: 'a\*' is no identity; name each in full"),
    "no revoked file": (
        "revoked_file = 'r.toml'\n" + ROLE.format(""),
        r"revoked_file: there is no .*r.toml\. Copy revoked.toml there from the authority",
    ),
    "revoked file no path": ("revoked_file = 1\n" + ROLE.format(""), r"revoked_file: must be a path"),
}


@pytest.mark.parametrize(("text", "problem"), WRONG.values(), ids=list(WRONG))
def test_a_wrong_policy_is_refused_with_file_key_and_remedy(tmp_path: Path, text: str, problem: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigurationError, match=problem) as refused:
        read_policy(path)
    assert str(path) in str(refused.value)


def test_a_wrong_file_of_revoked_identities_is_named(tmp_path: Path) -> None:
    beside = written(tmp_path, "revoke = []", "r.toml")
    with pytest.raises(ConfigurationError, match=r"revoke: unknown key; did you mean revoked\?") as refused:
        read_policy(written(tmp_path, 'revoked_file = "r.toml"\n' + ROLE.format("")))
    assert str(beside) in str(refused.value)


def test_an_incomplete_list_of_revoked_identities_is_refused(tmp_path: Path) -> None:
    written(tmp_path, "", "r.toml")  # as it is while it is being copied
    with pytest.raises(ConfigurationError, match=r"revoked: missing; write revoked = \[\] if no identity is revoked"):
        read_policy(written(tmp_path, 'revoked_file = "r.toml"\n' + ROLE.format("")))


def test_a_policy_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read: No such file"):
        read_policy(tmp_path / "none.toml")


NAMES = st.sampled_from(["a", "ab", "b", "ba", "c"])
PATTERNS = st.sampled_from(["a", "ab", "a*", "*", "?b", "c"])
GROUPS = st.sampled_from(["x", "x.y", "x.y.z", "xy", "w", "_"])
ROLES = ["r0", "r1", "r2", "r3"]


@st.composite
def policies(draw: st.DrawFn) -> tuple[list[Role], dict[str, list[str]], list[str]]:
    rule_groups = st.lists(st.one_of(GROUPS, st.just("*")), max_size=3)
    roles = [
        Role(name, draw(st.dictionaries(st.sampled_from(VERBS), rule_groups, max_size=3)), draw(_earlier(number)))
        for number, name in enumerate(ROLES)
    ]
    identities = draw(st.dictionaries(PATTERNS, st.lists(st.sampled_from(ROLES), max_size=2), max_size=4))
    return roles, identities, draw(st.lists(NAMES, max_size=1))


def _earlier(number: int) -> st.SearchStrategy[list[str]]:
    """Roles that come before: so there is no cycle."""
    return st.lists(st.sampled_from(ROLES[:number]), max_size=2) if number else st.just([])


def naive(roles: Sequence[Role], identities: Mapping[str, Sequence[str]], who: str, verb: str, group: str) -> bool:
    by_name = {role.name: role for role in roles}

    def allows(role: Role) -> bool:
        over = role.rights.get(verb, ())
        here = any(rule == "*" or group == rule or group.startswith(f"{rule}.") for rule in over)
        return here or any(allows(by_name[name]) for name in role.includes)

    return any(
        allows(by_name[name])
        for pattern, names in identities.items()
        if fnmatch.fnmatchcase(who, pattern)
        for name in names
    )


@given(policies(), NAMES, st.sampled_from(VERBS), GROUPS)
def test_decisions_are_those_of_reading_every_rule(
    made: tuple[list[Role], dict[str, list[str]], list[str]], who: str, verb: str, group: str
) -> None:
    roles, identities, revoked = made
    policy = Policy(roles, identities, revoked)
    expected = who not in revoked and naive(roles, identities, who, verb, group)
    assert policy.decide(who, verb, group).allowed is expected
    assert policy.decide(who, verb, group).allowed is expected  # also from what is kept
