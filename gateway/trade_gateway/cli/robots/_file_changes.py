"""Detects changes in the files that a gateway file names."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from trade.errors import ConfigurationError
from trade.policies import Certificate, Policy, different, policy_files, read_policy
from trade.text_files import read_text
from trade.toml_files import read_toml_text
from trade_gateway.config._gateway_file import Plan

_CERTIFICATE: Final = "cert.pem"


def digest(path: Path) -> str:
    """Returns a digest of the file and of all files that it names."""
    return _digest([path, *_beside(path)])


class FileDigests(NamedTuple):
    """The files that a gateway file names, at one moment."""

    digests: Mapping[Path, str]
    """Digests of policies, lists of revoked names and certificates."""
    policy: Policy | None
    """The gateway's own policy."""

    def since(self, before: "FileDigests") -> str:
        """Describes the changes in words; empty if there are none."""
        changed = [path for path, seen in self.digests.items() if before.digests.get(path) != seen]
        changes = [_certified(path) for path in changed if path.name == _CERTIFICATE]
        changes += [f"{path.name} has changed" for path in changed if path.name != _CERTIFICATE]
        if changed and self.policy is not None and before.policy is not None:
            changes += different(before.policy, self.policy)
        return ", ".join(changes)


def named_by(path: Path, plan: Plan) -> FileDigests:
    """Reads what a gateway file names now. Raises ConfigurationError if its policy has an error."""
    policy = plan.settings.policy
    return FileDigests(
        {file: _digest([file]) for file in _beside(path)}, None if policy is None else read_policy(policy)
    )


def _certified(path: Path) -> str:
    try:
        made = Certificate.read(path.parent)
    except ConfigurationError as wrong:
        return str(wrong)
    return f"new certificate of {made.identity} until {made.until:%Y-%m-%d %H:%M} UTC"


def _digest(files: Sequence[Path]) -> str:
    seen = hashlib.sha256()
    for file in files:
        try:
            seen.update(file.read_bytes())
        except OSError as gone:
            seen.update(str(gone.errno).encode())
    return seen.hexdigest()


def _beside(path: Path) -> list[Path]:
    try:
        raw = read_toml_text(read_text(path))
    except (OSError, ValueError):  # the reload reports the error
        return []
    shares = raw.get("share")
    parts = [raw, raw.get("system"), *(cast("Mapping[str, Any]", shares).values() if isinstance(shares, dict) else ())]
    tables = [cast("Mapping[str, Any]", part) for part in parts if isinstance(part, dict)]
    return [file for table in tables for file in _named_by(table, path)]


def _named_by(part: Mapping[str, Any], path: Path) -> list[Path]:
    certificates = [path.parent / str(part["tls"]) / _CERTIFICATE] if part.get("tls") else []
    return [*certificates, *(policy_files(path.parent / str(part["policy"])) if part.get("policy") else ())]
