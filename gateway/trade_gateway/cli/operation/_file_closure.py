"""Finds the files that a gateway file or a system file names, directly and indirectly."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import msgspec
from msgspec import Struct

from trade.errors import ConfigurationError
from trade_gateway.config._toml_file import read_toml

_CERTIFICATE: Final = ("ca.pem", "cert.pem", "key.pem")
_LOCAL: Final = "local"
_Table = TypeVar("_Table", bound=Struct)


class NamedFiles(NamedTuple):
    """The named files and folders as absolute paths; they need not exist."""

    files: tuple[Path, ...]
    """All files, beginning with the file itself."""
    robots: tuple[Path, ...]
    """The robot files among them."""
    records: tuple[Path, ...]
    """Folders of audit records."""
    systems: tuple[str, ...]
    """The ids of its systems, its own first."""
    containers: int
    """The number of containers on this host besides the gateway."""
    hub: bool
    """Whether it, or a gateway among those, is the hub of this host."""


class _Http(Struct):
    tokens: str = ""
    tls: str = ""
    twin: str = ""


class _Part(Struct, kw_only=True):
    """A table that may name files; its other keys are not checked here."""

    tls: str = ""
    policy: str = ""
    audit: str = ""
    robot: str = ""
    rules: str = ""
    ros: str = ""
    http: _Http | None = None
    gateway: str = ""
    host: str = _LOCAL

    def files(self, folder: Path) -> Iterator[Path]:
        """Returns the files of this host that it names directly."""
        http = self.http or _Http()
        for name in (self.robot, self.rules, self.ros, http.tokens, http.twin):
            if name:
                yield folder / name
        for tls in (self.tls, http.tls):
            if tls:
                yield from (folder / tls / name for name in _CERTIFICATE)
        if self.policy:
            policy = folder / self.policy
            yield policy
            if revoked := _read(policy, _Policy).revoked_file:
                yield policy.parent / revoked


class _System(_Part, kw_only=True):
    name: str


class _Share(_Part, kw_only=True):
    system: str


class _File(_Part, kw_only=True):
    system: str | _System
    share: dict[str, _Share] = {}
    container: dict[str, _Part] = {}
    hub: bool = False


class _Policy(Struct):
    revoked_file: str = ""


def named_files(path: Path) -> NamedFiles:
    """Reads a gateway file or a system file, and the files that it names.

    Raises:
        ConfigurationError: the file, or a policy that it names, cannot be read.
    """
    path = path.absolute()
    file = _read(path, _File)
    own = file.system if isinstance(file.system, _System) else _System(name=file.system)
    containers = [part for part in file.container.values() if part.host == _LOCAL]
    files, robots, records = [path], list[Path](), list[Path]()
    systems, hub = [own.name, *(share.system for share in file.share.values())], file.hub
    for part in (file, own, *file.share.values(), *containers):
        files += part.files(path.parent)
        robots += [path.parent / part.robot] if part.robot else []
        records += [path.parent / part.audit] if part.audit else []
        if part.gateway:
            inner = named_files(path.parent / part.gateway)
            files += inner.files
            robots += inner.robots
            records += inner.records
            systems += inner.systems
            hub = hub or inner.hub
    named = dict.fromkeys(systems)
    return NamedFiles(_once(files), _once(robots), _once(records), tuple(named), len(containers), hub)


def _once(paths: Iterable[Path]) -> tuple[Path, ...]:
    return tuple(dict.fromkeys(Path(os.path.normpath(path)) for path in paths))


def _read(path: Path, table_type: type[_Table]) -> _Table:
    _, raw = read_toml(path)
    try:
        return msgspec.convert(raw, table_type)
    except msgspec.ValidationError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad}") from None
