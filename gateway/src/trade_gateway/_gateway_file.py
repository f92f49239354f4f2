"""The gateway file: which networks are joined, what of each the others see, who may do what. Checked as a whole."""

import hashlib
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, cast

import msgspec
from msgspec import Meta, Struct

from trade import Settings
from trade.errors import ConfigurationError
from trade.policies import EVERYTHING, read_policy

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

__all__ = ["GatewayFile", "Network", "digest", "read_gateway_file"]

_GROUP: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*")
_AT: Final = re.compile(r" - at `\$\.?([^`]*)`$")
_MISSING: Final = re.compile(r"missing required field `([^`]*)`")
_UNKNOWN: Final = re.compile(r"contains unknown field `([^`]*)`")
_EXAMPLES: Final = {
    "system": 'system = "lab"',
    "network": '[network.private] and interface = "eth0"',
    "interface": 'interface = "eth0" (`ip link` shows those there are)',
    "listen": 'listen = ["tls/192.168.1.1:7450"]',
}

_Text = Annotated[str, Meta(min_length=1)]


class Network(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One network that the gateway has a foot in."""

    interface: _Text
    """Of this host, such as ``eth0``."""
    listen: list[_Text] = []
    """Endpoints on it; none is fine if the gateway only dials out by it."""
    export: list[str] | None = None
    """Groups whose services on this network the others see and call; an empty list: none; left out: all."""


class GatewayFile(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A gateway file, read; paths in it are beside it."""

    system: _Text
    """The system id."""
    name: _Text = "gateway"
    """Of its container."""
    tls: str = ""
    """The folder that `trade pki issue --for gateway` made."""
    policy: str = ""
    """The access policy."""
    connect: list[_Text] = []
    """Other gateways that it dials."""
    network: dict[str, Network]
    """By a name for people."""
    credentials: str = ""
    """Laboratories only, instead of ``tls``: ``user:password``."""
    insecure_lan: bool = False
    """Laboratories only: neither certificates nor encryption nor a policy."""

    def settings(self, where: Path) -> Settings:
        """What its container is started with.

        Raises:
            ConfigurationError: certificates, policy and endpoints do not fit together.
        """
        beside = where.parent
        if self.policy:
            read_policy(beside / self.policy)  # wrong is wrong before anything is closed for it
        limited = any(network.export is not None for network in self.network.values())
        exports = {network.interface: tuple(_or_all(network.export)) for network in self.network.values()}
        user, _, password = self.credentials.partition(":")
        return Settings.read(
            system=self.system,
            container=self.name,
            listen=[endpoint for network in self.network.values() for endpoint in network.listen],
            connect=self.connect,
            credentials=(user, password) if self.credentials else None,
            tls=beside / self.tls if self.tls else None,
            insecure_lan=self.insecure_lan,
            bridge=[network.interface for network in self.network.values()],
            exports=exports if limited else None,
            policy=beside / self.policy if self.policy else None,
            environment=_without_system(),
        )


def _or_all(groups: Sequence[str] | None) -> Sequence[str]:
    return (EVERYTHING,) if groups is None else groups


def _without_system() -> dict[str, str]:
    """The file says it all, and not whatever shell the gateway is started from; but for places on this host."""
    return {name: value for name, value in os.environ.items() if not name.startswith("TRADE_") or name.endswith("_DIR")}


def read_gateway_file(path: Path) -> tuple[GatewayFile, Settings]:
    """Read and check a gateway file, the policy and the certificate that it names.

    Raises:
        ConfigurationError: names the file, the key and what would be right.
    """
    where = str(path)
    try:
        raw = cast("dict[str, Any]", tomllib.loads(path.read_text(encoding="utf-8")))  # pyright: ignore[reportUnknownMemberType]
    except FileNotFoundError:
        raise ConfigurationError(where=where, problem="there is no such file") from None
    except OSError as bad:
        raise ConfigurationError(where=where, problem=f"cannot be read: {bad.strerror}") from None
    except ValueError as bad:  # tomllib.TOMLDecodeError is one, and so is text that is no UTF-8
        raise ConfigurationError(where=where, problem=f"not valid TOML: {bad}") from None
    try:
        file = msgspec.convert(raw, GatewayFile)
    except msgspec.ValidationError as bad:
        raise _explained(str(bad), raw, where) from None
    _check(file, where)
    return file, file.settings(path)


def _check(file: GatewayFile, where: str) -> None:
    owners: dict[str, str] = {}
    for name, network in file.network.items():
        if other := owners.get(network.interface):
            problem = f"{network.interface} is the interface of network {other!r} already"
            raise ConfigurationError(where=f"{where}: network.{name}.interface", problem=problem)
        owners[network.interface] = name
        for group in network.export or ():
            if group != EVERYTHING and not _GROUP.fullmatch(group):
                problem = f'{group!r} is no group; write "rosie.head" (it and all beneath it), or "*" for all'
                raise ConfigurationError(where=f"{where}: network.{name}.export", problem=problem)
    if file.credentials and not (file.insecure_lan and all(file.credentials.partition(":"))):
        problem = 'is for laboratories: "user:password", and insecure_lan = true; else use tls'
        raise ConfigurationError(where=f"{where}: credentials", problem=problem)
    if not file.tls and not file.credentials:
        problem = "missing; name the folder with its certificate: trade pki issue NAME --for gateway"
        raise ConfigurationError(where=f"{where}: tls", problem=problem)


def _explained(said: str, raw: Mapping[str, Any], where: str) -> ConfigurationError:
    at = _AT.search(said)
    path = at.group(1) if at else ""
    prefix = _named(path, raw)
    if missing := _MISSING.search(said):
        key = missing.group(1)
        return ConfigurationError(where=f"{where}: {prefix}{key}", problem=f"missing; write {_EXAMPLES.get(key, key)}")
    if unknown := _UNKNOWN.search(said):
        kind = Network if prefix.startswith("network.") else GatewayFile
        problem = f"unknown key; there is {', '.join(kind.__struct_fields__)}"
        return ConfigurationError(where=f"{where}: {prefix}{unknown.group(1)}", problem=problem)
    return ConfigurationError(where=f"{where}: {prefix.rstrip('.')}", problem=said[: at.start()] if at else said)


def _named(path: str, raw: Mapping[str, Any]) -> str:
    """The place of a value, with the network's own name where the check only says that it is one of them."""
    if "[...]" in path:
        networks = cast("Mapping[str, object]", raw.get("network", {}))
        path = path.replace("[...]", f".{next(iter(networks))}" if len(networks) == 1 else "", 1)
    return f"{path}." if path else ""


def digest(path: Path) -> str:
    """Changes when the file does, or the policy, its list of revoked names, or the certificate that it names."""
    seen = hashlib.sha256()
    for file in (path, *_beside(path)):
        try:
            seen.update(file.read_bytes())
        except OSError as gone:
            seen.update(str(gone.errno).encode())
    return seen.hexdigest()


def _beside(path: Path) -> list[Path]:
    found: list[Path] = []
    try:
        raw = cast("dict[str, Any]", tomllib.loads(path.read_text(encoding="utf-8")))  # pyright: ignore[reportUnknownMemberType]
        if raw.get("tls"):
            found.append(path.parent / str(raw["tls"]) / "cert.pem")
        if raw.get("policy"):
            policy = path.parent / str(raw["policy"])
            found.append(policy)
            rules = cast("dict[str, Any]", tomllib.loads(policy.read_text(encoding="utf-8")))  # pyright: ignore[reportUnknownMemberType]
            named = rules.get("revoked_file")
            found += [policy.parent / named] if isinstance(named, str) else []
    except (OSError, ValueError):  # what is wrong with it is said by who reads it
        return found
    return found
