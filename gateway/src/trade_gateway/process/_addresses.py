"""Addresses: whether one is of this host alone, how it is written, which interface has it, what the host passes on."""

import socket
import struct
import sys
from array import array
from collections.abc import Iterable, Mapping
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Final

__all__ = ["addresses", "forwarding", "in_url", "is_loopback"]

_SIOCGIFCONF: Final = 0x8912
_NAME: Final = 16
_REQUEST: Final = struct.Struct(f"{_NAME}s 2s 2s 4s {16 if struct.calcsize('P') > 4 else 8}x")
"""Linux's `struct ifreq` with an IPv4 address in it: name, family, port, address."""
_MOST: Final = 512
_IPV6: Final = Path("/proc/net/if_inet6")
_SYSCTLS: Final = Path("/proc/sys/net")


def is_loopback(host: str) -> bool:
    """Whether nobody beyond this host can reach it; a name other than ``localhost`` counts as reachable."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def in_url(host: str) -> str:
    """A host as it stands in a URL: IPv6 addresses have brackets there."""
    return f"[{host}]" if ":" in host else host


def addresses(ipv6: Path = _IPV6) -> Mapping[str, frozenset[str]]:
    """The addresses of each interface of this host, by its name; empty where there is no Linux to ask."""
    found: dict[str, set[str]] = {}
    for name, address in (*_of_ipv4(), *_of_ipv6(ipv6)):
        found.setdefault(name, set()).add(address)
    return {name: frozenset(known) for name, known in found.items()}


def _of_ipv4() -> Iterable[tuple[str, str]]:
    if sys.platform != "linux":
        return
    import fcntl  # noqa: PLC0415 - not every operating system has it

    room = array("B", bytes(_REQUEST.size * _MOST))
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        told = fcntl.ioctl(asking, _SIOCGIFCONF, struct.pack("iP", len(room), room.buffer_info()[0]))
        used: int = struct.unpack("iP", told)[0]
        for label, _, _, address in _REQUEST.iter_unpack(room.tobytes()[:used]):
            yield label.split(b"\0")[0].decode().partition(":")[0], socket.inet_ntoa(address)


def _of_ipv6(listing: Path) -> Iterable[tuple[str, str]]:
    with suppress(OSError):
        for line in listing.read_text(encoding="ascii").splitlines():
            digits, *_, name = line.split()
            yield name, str(ip_address(bytes.fromhex(digits)))


def forwarding(interfaces: Iterable[str], sysctls: Path = _SYSCTLS) -> list[str]:
    """The settings of the kernel that have it pass on packets which come in by one of these interfaces."""
    on: list[str] = []
    for version in ("ipv4", "ipv6"):
        for name in interfaces:
            with suppress(OSError):
                if (sysctls / version / "conf" / name / "forwarding").read_text(encoding="ascii").strip() != "0":
                    on.append(f"net.{version}.conf.{name}.forwarding")
    return on
