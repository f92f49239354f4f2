"""Endpoints: ``protocol/host:port``, where a container listens or dials."""

import ipaddress
import socket
from typing import Final, NamedTuple

from trade.errors import ConfigurationError

_EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104 - wildcard address -> address to dial

_PROTOCOLS: Final = ("tcp", "udp", "tls", "quic", "ws")
_LAST_PORT: Final = 65535


class Endpoint(NamedTuple):
    """The parts of one endpoint."""

    protocol: str
    host: str
    """As in the text: an IPv6 address keeps its brackets."""
    port: int
    rest: str = ""
    """The part after ``?`` or ``#``, which zenoh interprets."""

    @classmethod
    def read(cls, text: str) -> "Endpoint":
        """Raises ConfigurationError: the text is not an endpoint."""
        protocol, slash, where = text.partition("/")
        plain = where.split("#")[0].split("?")[0]
        host, colon, port = plain.rpartition(":")
        if not (protocol and slash and host and colon and port.isascii() and port.isdigit()):
            raise ConfigurationError(where=f"endpoint {text!r}", problem="must look like tcp/127.0.0.1:7450")
        if protocol not in _PROTOCOLS:
            problem = f"there is no protocol {protocol!r}; there is {', '.join(_PROTOCOLS)}"
            raise ConfigurationError(where=f"endpoint {text!r}", problem=problem)
        if int(port) > _LAST_PORT:
            problem = f"there is no port {port}; ports go up to {_LAST_PORT}"
            raise ConfigurationError(where=f"endpoint {text!r}", problem=problem)
        return cls(protocol, host, int(port), where[len(plain) :])

    @property
    def loopback(self) -> bool:
        """Whether the endpoint stays on this host."""
        try:
            return ipaddress.ip_address(self.host.strip("[]")).is_loopback
        except ValueError:
            return self.host == "localhost"

    @property
    def named(self) -> bool:
        """Whether the host is a name, which may have other addresses at each look."""
        try:
            ipaddress.ip_address(self.host.strip("[]").partition("%")[0])
        except ValueError:
            return self.host != "localhost"
        return False

    @property
    def everywhere(self) -> bool:
        """Whether the endpoint listens on all networks of this host."""
        return self.host in _EVERYWHERE

    def resolved(self) -> list[str]:
        """The endpoint with each current address of its host; empty if the host cannot be resolved."""
        try:
            found = socket.getaddrinfo(self.host.strip("[]"), self.port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError, OverflowError):
            return []
        addresses = dict.fromkeys(str(address[4][0]) for address in found)
        return [f"{self.protocol}/{f'[{ip}]' if ':' in ip else ip}:{self.port}" for ip in addresses]

    def __str__(self) -> str:
        return f"{self.protocol}/{self.host}:{self.port}{self.rest}"


def with_free_port(endpoint: Endpoint) -> Endpoint:
    """Replaces port 0 with a port that is free now."""
    if endpoint.port:
        return endpoint
    host = endpoint.host.strip("[]")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
            return endpoint._replace(port=probe.getsockname()[1])
    except OSError:  # the transport will report what is wrong with it
        return endpoint


def free_endpoint() -> str:
    """A loopback endpoint with a port that is free now."""
    return str(with_free_port(Endpoint("tcp", "127.0.0.1", 0)))


def loopback_interface() -> str:
    """The name of this host's loopback interface; empty if there is none."""
    return next((name for _, name in socket.if_nameindex() if name.startswith("lo")), "")


def dialled_from_here(endpoint: Endpoint) -> str:
    """The endpoint under which this host dials a listener."""
    return str(endpoint._replace(host=_EVERYWHERE.get(endpoint.host, endpoint.host)))


def accepts(endpoint: str) -> bool:
    """Whether an endpoint accepts connections; False for a text or name that is not valid."""
    try:
        where = Endpoint.read(endpoint)
        with socket.create_connection((where.host.strip("[]"), where.port), timeout=0.5):
            return True
    except (OSError, ValueError, OverflowError):
        return False
