"""The gateway file: networks, exports, policy and supervised containers; checked as a whole."""

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, cast

import msgspec
from msgspec import Meta, Struct

from trade import Settings
from trade.errors import ConfigurationError
from trade.policies import EVERYTHING, Certificate, read_policy
from trade.toml_files import Mismatch, mismatch
from trade.transport.endpoints import Endpoint, loopback_interface
from trade_gateway.config._children import Child, read_children
from trade_gateway.config._entry import FileDefaults
from trade_gateway.config._supervised_system import as_gateway
from trade_gateway.config._toml_file import read_toml
from trade_gateway.process._addresses import addresses

_GROUP: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*")
_UNKNOWN_LOOPBACK: Final = re.compile(r"/127\.(?!0\.0\.1:)")
"""Addresses that the transport cannot assign to an interface, so that it would apply no rule."""
_EXAMPLES: Final = {
    "system": 'system = "lab"',
    "network": '[network.private] and interface = "eth0"',
    "interface": 'interface = "eth0" (`ip link` lists the interfaces)',
    "listen": 'listen = ["tls/192.168.1.1:7450"]',
}

_Text = Annotated[str, Meta(min_length=1)]


class Network(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One network that the gateway joins."""

    interface: _Text
    """An interface of this host, such as ``eth0``."""
    listen: list[_Text] = []
    """Endpoints on it; none if the gateway only connects to others."""
    export: list[str] | None = None
    """Groups of this network that the others can see and call; empty: none; left out: all."""
    stream_hz: float | dict[str, float] = {}
    """The highest rate of each stream that the others receive, in Hz: for all groups, or by group."""

    @property
    def limits(self) -> Mapping[str, float]:
        """The highest rates by group."""
        if isinstance(self.stream_hz, dict):
            return self.stream_hz
        return dict.fromkeys(_or_all(self.export), self.stream_hz)


class Share(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"import_": "import"}):
    """Another system with which the gateway, as a guest there, shares groups."""

    system: _Text
    """Its system id."""
    tls: str = ""
    """The folder with the guest's certificate, of that system's authority."""
    policy: str = ""
    """That system's policy, which restricts who may see and call the shared groups."""
    connect: list[_Text] = []
    """Endpoints in it to connect to."""
    listen: list[_Text] = []
    """Endpoints on which the guest accepts its containers."""
    export: list[str] = []
    """Our groups that the other system can see and call."""
    import_: list[str] = []
    """The other system's groups that ours can see and call."""
    credentials: str = ""
    """Laboratories only, instead of ``tls``: ``user:password``."""

    def settings(self, where: Path, name: str, audit: Path | None, *, insecure_lan: bool) -> Settings:
        """Returns the guest's settings. Raises ConfigurationError."""
        if self.policy:
            read_policy(where.parent / self.policy)
        return Settings.read(
            system=self.system,
            container=name,
            audit=audit,
            listen=self.listen,
            connect=self.connect,
            credentials=_pair(self.credentials),
            tls=where.parent / self.tls if self.tls else None,
            insecure_lan=insecure_lan,
            bridge=[],
            policy=where.parent / self.policy if self.policy else None,
            environment=_without_system(),
        )


class GatewayFile(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The contents of a gateway file; its paths are relative to it."""

    system: _Text
    """The system id."""
    name: _Text = "gateway"
    """The name of its container."""
    tls: str = ""
    """The folder that `trade pki issue --for gateway` made."""
    policy: str = ""
    """The access policy."""
    metrics: str = ""
    """Where Prometheus finds its metrics: ``127.0.0.1:9464``."""
    audit: str = ""
    """The folder of the audit records of the gateway and its guests in other systems."""
    connect: list[_Text] = []
    """Other gateways that it connects to."""
    hub: bool = False
    """Whether it is the hub of its host, too."""
    network: dict[str, Network] = {}
    """Networks by a name for people; at least one, unless the gateway only shares or supervises."""
    share: dict[str, Share] = {}
    """Other systems, by a name for people."""
    container: dict[str, dict[str, Any]] = {}
    """Containers of this host that it supervises, by name."""
    credentials: str = ""
    """Laboratories only, instead of ``tls``: ``user:password``."""
    insecure_lan: bool = False
    """Laboratories only: neither certificates nor encryption nor a policy."""

    @property
    def alone(self) -> bool:
        """Whether it joins no networks of its system: it only shares."""
        return bool(self.share) and len(self.network) < 2 and not self.connect

    def settings(self, where: Path) -> Settings:
        """Returns its container's settings.

        Raises:
            ConfigurationError: certificates, policy and endpoints do not fit together.
        """
        beside = where.parent
        if self.policy:
            policy = read_policy(beside / self.policy)  # an error is found before anything is closed
            self._check_certificate(where, policy.gateways)
        networks = [] if self.alone else list(self.network.values())
        limited = any(network.export is not None or network.limits for network in networks)
        exports = {network.interface: tuple(_or_all(network.export)) for network in networks}
        return Settings.read(
            system=self.system,
            container=self.name,
            listen=[endpoint for network in self.network.values() for endpoint in network.listen],
            connect=self.connect,
            credentials=_pair(self.credentials),
            tls=beside / self.tls if self.tls else None,
            insecure_lan=self.insecure_lan,
            bridge=[network.interface for network in networks],
            hub="serve" if self.hub else "off",
            exports=exports if limited else None,
            stream_hz={network.interface: network.limits for network in networks},
            policy=beside / self.policy if self.policy else None,
            audit=self.audit_folder(where),
            metrics=self.metrics,
            environment=_without_system(),
        )

    def _check_certificate(self, where: Path, gateways: Collection[str]) -> None:
        """Raises ConfigurationError if the certificate is a container's, and for none of the addresses."""
        if not (self.tls and gateways):
            return
        certificate = Certificate.read((where.parent / self.tls).absolute())
        hosts = [Endpoint.read(one).host for network in self.network.values() for one in network.listen]
        if certificate.identity not in gateways and hosts and not certificate.hosts.intersection(hosts):
            problem = (
                f"{certificate.folder} has the certificate of {certificate.identity!r}, which the policy does not list "
                f"in gateways ({', '.join(gateways)}) and which is not for {hosts[0]}; use a gateway's: trade pki "
                f"issue NAME --for gateway --address {hosts[0]}"
            )
            raise ConfigurationError(where=f"{where}: tls", problem=problem)

    def audit_folder(self, where: Path) -> Path | None:
        """Returns the folder of audit records, relative to the file."""
        return where.parent / self.audit if self.audit else None


def _pair(credentials: str) -> tuple[str, str] | None:
    user, _, password = credentials.partition(":")
    return (user, password) if credentials else None


def _or_all(groups: Sequence[str] | None) -> Sequence[str]:
    return (EVERYTHING,) if groups is None else groups


def _without_system() -> dict[str, str]:
    """Returns the environment without settings of a system, which only the file sets."""
    kept = ("TRADE_AUDIT_READS", "TRADE_AUDIT_KEEP_DAYS", "TRADE_AUDIT_KEEP_ROWS")
    return {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("TRADE_") or name.endswith("_DIR") or name in kept
    }


_KINDS: Final[Mapping[str, type[Struct]]] = {"network": Network, "share": Share}


class Plan(NamedTuple):
    """A checked gateway file, with the files that it names."""

    file: GatewayFile
    settings: Settings
    shares: Mapping[str, Settings]
    """The settings of the guests in other systems, by the name of the share."""
    children: Sequence[Child]
    """The containers that it supervises, in the order in which they are started."""

    @property
    def unnamed(self) -> str:
        """The problem of a policy that does not name the gateway, or an empty text.

        Raises:
            ConfigurationError: the policy has an error.
        """
        carries = self.settings.bridge and self.settings.tls is not None
        if not carries or self.settings.policy is None:
            return ""
        name = self.settings.identity
        named = read_policy(self.settings.policy).gateways
        if name in named:
            return ""
        listed = ", ".join(f'"{one}"' for one in (*named, name))
        return f"does not name the gateway {name!r}, so containers refuse what it forwards; write gateways = [{listed}]"

    def check_here(self, where: Path) -> None:
        """Checks that each network listens at addresses of its own interface, as far as this host has them.

        A link belongs to the network whose interface has the address. With two addresses swapped, clients of one
        network would see services of the other.

        Raises:
            ConfigurationError: an address is of another interface of this host.
        """
        here, known = loopback_interface(), addresses()
        interfaces = [network.interface for network in self.file.network.values()]
        for name, network in self.file.network.items():
            own = {network.interface}
            if network.interface == interfaces[0] and here not in interfaces:
                own.add(here)  # containers of the gateway's host belong to the first network
            for endpoint in network.listen:
                if others := _others_at(endpoint, own, known):
                    problem = (
                        f"{endpoint} is an address of {', '.join(others)} on this host, and interface is "
                        f"{network.interface}: links there would count as another network's, and see services that it "
                        f"does not export; write an address of {network.interface} "
                        f"({_listed(known.get(network.interface, ()))}), or the interface that has this one"
                    )
                    raise ConfigurationError(where=f"{where}: network.{name}.listen", problem=problem)


def _others_at(endpoint: str, own: set[str], known: Mapping[str, frozenset[str]]) -> list[str]:
    """Returns the interfaces of this host that have an address of an endpoint, if none of its own has."""
    place = Endpoint.read(endpoint)
    if place.everywhere:
        return []
    for one in place.resolved():
        address = Endpoint.read(one).host.strip("[]").partition("%")[0]
        having = sorted(name for name, has in known.items() if address in has)
        if having and not own.intersection(having):
            return having
    return []


def _listed(known: Iterable[str]) -> str:
    return ", ".join(sorted(known)) or "this host has none of it"


def read_gateway_file(path: Path) -> Plan:
    """Reads and checks a gateway file, and the policy and certificate that it names.

    Raises:
        ConfigurationError: with the file, the key and the remedy.
    """
    where = str(path)
    text, contents = read_toml(path)
    raw = as_gateway(path, text, contents)
    try:
        file = msgspec.convert(raw, GatewayFile)
    except msgspec.ValidationError as bad:
        raise _explained(mismatch(bad), raw, where) from None
    _check(file, where)
    shares = {
        name: share.settings(path, file.name, file.audit_folder(path), insecure_lan=file.insecure_lan)
        for name, share in file.share.items()
    }
    laboratory = _of_children(file)
    defaults = FileDefaults(
        system=file.system,
        policy=file.policy,
        audit=file.audit,
        environment=laboratory,
        inherited=_without_system(),
    )
    children = read_children(path, text, defaults, file.container, certified=bool(file.tls))
    return Plan(file, file.settings(path), shares, children)


def _of_children(file: GatewayFile) -> dict[str, str]:
    """Returns the variables that give containers of this host the gateway's laboratory credentials."""
    laboratory = {"TRADE_CREDENTIALS": file.credentials, "TRADE_INSECURE_LAN": "1" if file.insecure_lan else ""}
    return {name: value for name, value in laboratory.items() if value}


def _check(file: GatewayFile, where: str) -> None:
    if not (file.network or file.share or file.container):
        raise ConfigurationError(where=f"{where}: network", problem=f"missing; write {_EXAMPLES['network']}")
    _check_networks(file, where)
    if file.network or file.share or file.connect:
        _check_proof(file, file, f"{where}: ", "NAME --for gateway")
    for name, share in file.share.items():
        at = f"{where}: share.{name}."
        if share.system in (file.system, *(one.system for known, one in file.share.items() if known != name)):
            problem = f"{share.system!r} is this system or that of another share; name another one, once"
            raise ConfigurationError(where=f"{at}system", problem=problem)
        _check_groups(share.export, f"{at}export")
        _check_groups(share.import_, f"{at}import")
        _check_proof(file, share, at, f"NAME, by the authority of {share.system}")
        if not share.policy and not file.insecure_lan:
            problem = (
                f"missing; name the policy of {share.system}: without one, all its clients could call the shared groups"
            )
            raise ConfigurationError(where=f"{at}policy", problem=problem)


def _check_networks(file: GatewayFile, where: str) -> None:
    owners: dict[str, str] = {}
    for name, network in file.network.items():
        if other := owners.get(network.interface):
            problem = f"{network.interface} is the interface of network {other!r} already"
            raise ConfigurationError(where=f"{where}: network.{name}.interface", problem=problem)
        owners[network.interface] = name
        for endpoint in network.listen:
            if _UNKNOWN_LOOPBACK.search(endpoint):
                problem = f"{endpoint}: lo works only with 127.0.0.1; use that address"
                raise ConfigurationError(where=f"{where}: network.{name}.listen", problem=problem)
        _check_groups(network.export or (), f"{where}: network.{name}.export")
        given = {"export": network.export is not None, "stream_hz": network.stream_hz != {}}
        for key in [key for key, is_given in given.items() if is_given and file.alone]:
            problem = "there is no other network of this system; leave it out. [share...] sets what other systems see"
            raise ConfigurationError(where=f"{where}: network.{name}.{key}", problem=problem)


def _check_groups(groups: Sequence[str], where: str) -> None:
    for group in groups:
        if group != EVERYTHING and not _GROUP.fullmatch(group):
            problem = f'{group!r} is no group; write "rosie.head" (it and all beneath it), or "*" for all'
            raise ConfigurationError(where=where, problem=problem)


def _check_proof(file: GatewayFile, part: GatewayFile | Share, where: str, words: str) -> None:
    if part.credentials and not (file.insecure_lan and all(part.credentials.partition(":"))):
        problem = 'is for laboratories: "user:password", and insecure_lan = true; else use tls'
        raise ConfigurationError(where=f"{where}credentials", problem=problem)
    if not part.tls and not part.credentials:
        problem = f"missing; name the folder with its certificate: trade pki issue {words}"
        raise ConfigurationError(where=f"{where}tls", problem=problem)


def _explained(found: Mismatch, raw: Mapping[str, Any], where: str) -> ConfigurationError:
    prefix = _named(found.place, raw)
    if key := found.missing:
        return ConfigurationError(where=f"{where}: {prefix}{key}", problem=f"missing; write {_EXAMPLES.get(key, key)}")
    if found.unknown:
        kind = _KINDS.get(prefix.partition(".")[0], GatewayFile)
        problem = f"unknown key; there is {', '.join(kind.__struct_encode_fields__)}"
        return ConfigurationError(where=f"{where}: {prefix}{found.unknown}", problem=problem)
    return ConfigurationError(where=f"{where}: {prefix.rstrip('.')}", problem=found.problem)


def _fits(part: object, type_: type[Struct] | None) -> bool:
    try:
        msgspec.convert(part, type_ or dict[str, Any])
    except msgspec.ValidationError:
        return False
    return True


def _named(path: str, raw: Mapping[str, Any]) -> str:
    """Returns the place of a value, with the name of its network or share where the check leaves it out."""
    if "[...]" in path:
        table = path.partition("[")[0]
        named = cast("Mapping[str, object]", raw.get(table, {}))
        wrong = next((name for name, part in named.items() if not _fits(part, _KINDS.get(table))), "")
        path = path.replace("[...]", f".{wrong}" if wrong else "", 1)
    return f"{path}." if path else ""
