"""Reads a policy from its TOML file: checks the whole file before any of it applies."""

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, cast

from trade._security.policy import EVERYTHING, VERBS, Policy, Role
from trade.errors import ConfigurationError
from trade.protocol.keys import GROUP, NO_GROUP, is_chunk
from trade.text_files import read_text
from trade.toml_files import read_toml_text

Seen = tuple[tuple[int, int, int, int] | None, ...]
"""The state of files: inode, times of change of contents and of rights, and size of each; None: it does not exist."""

_PATTERN: Final = re.compile(r"[A-Za-z0-9_.@:*?-]{1,80}")
_KEYS: Final = ("roles", "identities", "gateways", "revoked", "revoked_file", "approval")
_ROLE_KEYS: Final = (*VERBS, "includes")
_EXAMPLES: Final = {
    "roles": '[roles.operator] and call = ["rosie"]',
    "identities": '[identities] and planner = ["operator"]',
    "approval": '[approval] and "agent-*" = ["rosie.legs"]',
}
_Table = Mapping[str, object]


def read_policy(path: Path, text: str | None = None) -> Policy:
    """Read a policy, and the file of revoked identities that it names.

    Args:
        path: the file.
        text: contents to check in its place, before they are written.

    Raises:
        ConfigurationError: names the file, the key and the right form.
    """
    raw = _load(path, text)
    where = str(path)
    _only_known(raw, _KEYS, where)
    roles = _roles(raw, where)
    identities = {
        _checked_identity(name, f"{where}: identities"): _role_names(names, roles, f'{where}: identities."{name}"')
        for name, names in _table(raw, "identities", where).items()
    }
    revoked = _names(raw, "revoked", where)
    beside = raw.get("revoked_file")
    if beside is not None:
        if not isinstance(beside, str) or not beside:
            raise _wrong(f"{where}: revoked_file", 'must be a path, such as revoked_file = "revoked.toml"')
        revoked = (*revoked, *_revoked_elsewhere(path.parent / beside, where))
    marked: _Table = _table(raw, "approval", where) if "approval" in raw else {}
    approval = {
        _checked_identity(name, f"{where}: approval"): _groups(groups, f'{where}: approval."{name}"')
        for name, groups in marked.items()
    }
    return Policy(roles.values(), identities, revoked, where, _names(raw, "gateways", where), approval)


def policy_files(path: Path) -> tuple[Path, ...]:
    """The policy's file and the file of revoked identities that it names; only the former if it cannot be read."""
    try:
        beside = read_toml_text(read_text(path)).get("revoked_file")
    except (OSError, ValueError):
        return (path,)
    return (path, path.parent / beside) if isinstance(beside, str) else (path,)


def look_at(files: Iterable[Path]) -> Seen:
    """The state of files; it differs once one of them has been written."""
    return tuple(_stamp(file) for file in files)


def _stamp(file: Path) -> tuple[int, int, int, int] | None:
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size


def _load(path: Path, text: str | None = None) -> _Table:
    try:
        text = read_text(path) if text is None else text
    except (OSError, ValueError) as bad:
        reason = bad.strerror if isinstance(bad, OSError) and bad.strerror else str(bad)
        raise _wrong(str(path), f"the policy cannot be read: {reason}. Write the file, or name another one") from None
    try:
        return read_toml_text(text)
    except ValueError as bad:
        raise _wrong(str(path), f"not valid TOML: {bad}") from None


def _roles(raw: _Table, where: str) -> dict[str, Role]:
    tables = _table(raw, "roles", where)
    roles: dict[str, Role] = {}
    for name, table in tables.items():
        at = f"{where}: roles.{name}"
        if not is_chunk(name):
            raise _wrong(at, f"{name!r} is not a valid name of a role; use letters, digits, . _ - (at most 80)")
        if not isinstance(table, dict):
            raise _wrong(at, f'must be a table: [roles.{name}] and, for instance, call = ["rosie"]')
        rights = cast("_Table", table)
        _only_known(rights, _ROLE_KEYS, at)
        roles[name] = Role(
            name,
            {verb: _groups(rights[verb], f"{at}.{verb}") for verb in VERBS if verb in rights},
            _texts(rights.get("includes", []), f"{at}.includes", '["viewer"]'),
        )
    for role in roles.values():
        _check_includes(role, roles, where)
    return roles


def _check_includes(role: Role, roles: Mapping[str, Role], where: str) -> None:
    at = f"{where}: roles.{role.name}.includes"
    _role_names(role.includes, roles, at)
    trail, open_ = {role.name: ""}, [(role.name, name) for name in role.includes]
    while open_:
        by, name = open_.pop()
        if name == role.name:
            way = [by]
            while way[0] != role.name:
                way.insert(0, trail[way[0]])
            raise _wrong(at, f"a role cannot include itself: {' -> '.join([*way, name])}; leave one of these out")
        if name not in trail and name in roles:
            trail[name] = by
            open_ += [(name, other) for other in roles[name].includes]


def _groups(value: object, at: str) -> tuple[str, ...]:
    groups = _texts(value, at, '["rosie.neck"], or ["*"] for everything')
    for group in groups:
        if group not in (EVERYTHING, NO_GROUP) and not GROUP.fullmatch(group):
            problem = f"{group!r} is no group; write rosie.neck (it and all beneath it), * for all, _ for none"
            raise _wrong(at, problem)
    return groups


def _role_names(value: object, roles: Mapping[str, Role], at: str) -> tuple[str, ...]:
    names = _texts(value, at, '["operator"]')
    for name in names:
        if name not in roles:
            raise _wrong(at, f"there is no role {name!r}; {_instead(name, list(roles))}")
    return names


def _checked_identity(name: str, at: str) -> str:
    if not _PATTERN.fullmatch(name):
        problem = f"{name!r} is no identity; use letters, digits, . _ @ : - and, for several, * and ?"
        raise _wrong(at, problem)
    return name


def _names(raw: _Table, key: str, where: str) -> tuple[str, ...]:
    names = _texts(raw.get(key, []), f"{where}: {key}", '["name"]')
    for name in names:
        if not is_chunk(name):
            raise _wrong(f"{where}: {key}", f"{name!r} is no identity; name each in full, without patterns")
    return names


def _revoked_elsewhere(path: Path, named_in: str) -> tuple[str, ...]:
    if not path.exists():
        problem = (
            f"there is no {path}. Copy revoked.toml there from the authority's folder (`trade pki` keeps it beside "
            "ca.pem), and again after each `trade pki revoke`: an empty file would admit revoked identities"
        )
        raise _wrong(f"{named_in}: revoked_file", problem)
    raw = _load(path)
    _only_known(raw, ("revoked",), str(path))
    if "revoked" not in raw:  # a partly copied file would clear the list
        raise _wrong(f"{path}: revoked", 'missing; write revoked = [] if no identity is revoked, or revoked = ["name"]')
    return _names(raw, "revoked", str(path))


def _table(raw: _Table, key: str, where: str) -> _Table:
    value = raw.get(key)
    if value is None:
        raise _wrong(f"{where}: [{key}]", f"missing; write {_EXAMPLES[key]}")
    if not isinstance(value, dict):
        raise _wrong(f"{where}: {key}", f"must be a table: [{key}]")
    return cast("_Table", value)


def _texts(value: object, at: str, example: str) -> tuple[str, ...]:
    items = cast("Sequence[object]", value) if isinstance(value, (list, tuple)) else None
    if items is None or not all(isinstance(item, str) for item in items):
        raise _wrong(at, f"must be a list of texts, such as {example}, but it is {value!r}")
    return tuple(cast("Sequence[str]", items))


def _only_known(raw: _Table, known: Sequence[str], where: str) -> None:
    for key in raw:
        if key not in known:
            raise _wrong(f"{where}: {key}", f"unknown key; {_instead(key, known)}")


def _instead(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"there is {', '.join(known) or 'none'}"


def _wrong(where: str, problem: str) -> ConfigurationError:
    return ConfigurationError(where=where, problem=problem)
