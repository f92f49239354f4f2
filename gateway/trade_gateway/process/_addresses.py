"""IP addresses: loopback check, form in a URL, addresses of interfaces, forwarding by the host."""

import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Final

_SYSCTLS: Final = Path("/proc/sys/net")


def is_loopback(host: str) -> bool:
    """Whether only this host can reach it; a name other than ``localhost`` counts as reachable by others."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def in_url(host: str) -> str:
    """Returns a host as part of a URL, with brackets around IPv6 addresses."""
    return f"[{host}]" if ":" in host else host


def addresses() -> Mapping[str, frozenset[str]]:
    """Returns the addresses of each interface of this host by name; empty if the system does not list them."""
    import psutil  # noqa: PLC0415 - commands that need no list of interfaces start without it

    found: dict[str, set[str]] = {}
    with suppress(OSError):
        for label, listed in psutil.net_if_addrs().items():
            own = found.setdefault(label.partition(":")[0], set())
            own.update(_bare(one.address) for one in listed if one.family in (socket.AF_INET, socket.AF_INET6))
    return {name: frozenset(own) for name, own in found.items() if own}


def _bare(address: str) -> str:
    """Removes the interface from a link-local address."""
    return str(ip_address(address.partition("%")[0]))


def forwarding(interfaces: Iterable[str], sysctls: Path = _SYSCTLS) -> list[str]:
    """Returns the kernel settings that forward packets received on one of these interfaces."""
    on: list[str] = []
    for version in ("ipv4", "ipv6"):
        for name in interfaces:
            with suppress(OSError):
                if (sysctls / version / "conf" / name / "forwarding").read_text(encoding="ascii").strip() != "0":
                    on.append(f"net.{version}.conf.{name}.forwarding")
    return on
