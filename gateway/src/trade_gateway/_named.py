"""Which files a gateway file or a system file names, with those that they name in turn."""

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from trade.errors import ConfigurationError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

__all__ = ["Named", "named_files"]

_CERTIFICATE: Final = ("ca.pem", "cert.pem", "key.pem")
_LOCAL: Final = "local"


class Named(NamedTuple):
    """What is named, without asking whether it is there."""

    files: tuple[Path, ...]
    """The file itself first."""
    robots: tuple[Path, ...]
    """Those of them that are robot files."""
    containers: int
    """How many containers of this host it names."""


def named_files(path: Path) -> Named:
    """Look through a file that has been found right.

    Raises:
        ConfigurationError: it cannot be read any more.
    """
    parts = [part for part in _parts(_read(path)) if part.get("host", _LOCAL) == _LOCAL]
    files, robots = [path], list[Path]()
    for part in parts:
        files += _files(part, path.parent)
        robots += [path.parent / part["robot"]] if part.get("robot") else []
        if part.get("gateway"):
            inner = named_files(path.parent / part["gateway"])
            files += inner.files
            robots += inner.robots
    containers = sum(1 for part in parts if any(part.get(kind) is not None for kind in ("robot", "providers", "rules")))
    return Named(tuple(dict.fromkeys(files)), tuple(dict.fromkeys(robots)), containers)


def _parts(raw: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The file itself, and the tables in it that name files."""
    yield raw
    if isinstance(raw.get("system"), dict):  # a system file
        yield raw["system"]
    for tables in (raw.get("share", {}), raw.get("container", {})):
        yield from tables.values()


def _files(part: Mapping[str, Any], folder: Path) -> Iterator[Path]:
    for key in ("robot", "rules"):
        if part.get(key):
            yield folder / part[key]
    if part.get("tls"):
        yield from (folder / part["tls"] / name for name in _CERTIFICATE)
    if part.get("policy"):
        policy = folder / part["policy"]
        yield policy
        if revoked := _read(policy).get("revoked_file"):
            yield policy.parent / revoked


def _read(path: Path) -> dict[str, Any]:
    try:
        return cast("dict[str, Any]", tomllib.loads(path.read_text(encoding="utf-8")))  # pyright: ignore[reportUnknownMemberType]
    except (OSError, ValueError) as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad}") from None
