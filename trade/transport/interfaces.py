"""The addresses that this host has at this moment, asked of the kernel each time: they come and go while it runs."""

import ipaddress
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Final, NamedTuple

try:
    import fcntl
except ImportError:  # only some operating systems have it
    fcntl = None

_DUMP_ADDRESSES: Final = 22
_REQUEST_DUMP: Final = 0x301
_NEW_ADDRESS: Final = 20
_DONE: Final = 3
_ADDRESS: Final = 1
_LOCAL: Final = 2
_HEADER: Final = struct.Struct("=IHHII")
_ABOUT: Final = struct.Struct("=BBBBI")
_ATTRIBUTE: Final = struct.Struct("=HH")
_FLAGS_OF: Final = 0x8913
_MULTICAST: Final = 0x1000
_FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)


class OwnAddress(NamedTuple):
    """One address of this host."""

    ip: str
    bits: int
    """Of the network that the address is in."""
    interface: int
    """The kernel's number of the interface; 0 if it is not known."""

    @property
    def loopback(self) -> bool:
        return ipaddress.ip_address(self.ip).is_loopback

    @property
    def dialled(self) -> bool:
        """Whether other hosts can dial it; an IPv6 address of one link cannot be without that host's interface."""
        return not (self.loopback or ipaddress.ip_address(self.ip).is_link_local)

    @property
    def multicasts(self) -> bool:
        """Whether the interface carries multicast by its flags; the loopback interface does so without the flag."""
        if self.loopback or fcntl is None:
            return True
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            try:
                name = socket.if_indextoname(self.interface).encode()
                flags = fcntl.ioctl(asking, _FLAGS_OF, struct.pack("16sH14x", name, 0))
            except OSError:  # it just went away
                return False
        return bool(struct.unpack("16xH14x", flags)[0] & _MULTICAST)

    def reaches(self, ip: str) -> bool:
        """Whether another address is in the same network."""
        return ipaddress.ip_address(ip) in ipaddress.ip_network(f"{self.ip}/{self.bits}", strict=False)


def own_addresses() -> list[OwnAddress]:
    """The addresses of this host, in the kernel's order."""
    if sys.platform != "linux":
        found = socket.getaddrinfo(socket.gethostname(), 0, type=socket.SOCK_STREAM)
        return [OwnAddress(str(info[4][0]), 128 if info[0] == socket.AF_INET6 else 32, 0) for info in found]
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        kernel.settimeout(1.0)
        kernel.send(_HEADER.pack(_HEADER.size + 1, _DUMP_ADDRESSES, _REQUEST_DUMP, 1, 0) + bytes(1))
        addresses: list[OwnAddress] = []
        while True:
            for kind, body in _messages(kernel.recv(1 << 16)):
                if kind == _DONE:
                    return addresses
                if kind == _NEW_ADDRESS:
                    addresses += _read(body)


def _messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    while len(data) >= _HEADER.size:
        size, kind, *_ = _HEADER.unpack_from(data)
        yield kind, data[_HEADER.size : size]
        data = data[max((size + 3) & ~3, _HEADER.size) :]


def _read(body: bytes) -> Iterator[OwnAddress]:
    family, bits, _, _, interface = _ABOUT.unpack_from(body)
    if family not in _FAMILIES:
        return
    rest, values = body[_ABOUT.size :], dict[int, bytes]()
    while len(rest) >= _ATTRIBUTE.size:
        size, kind = _ATTRIBUTE.unpack_from(rest)
        values[kind] = rest[_ATTRIBUTE.size : size]
        rest = rest[max((size + 3) & ~3, _ATTRIBUTE.size) :]
    raw = values.get(_LOCAL) or values.get(_ADDRESS)  # of a point-to-point link, the other one is the peer's
    if raw:
        yield OwnAddress(socket.inet_ntop(family, raw), bits, interface)


def is_near(host: str) -> bool:
    """Whether an address is in a network of this host."""
    try:
        return any(own.reaches(host) for own in own_addresses())
    except (ValueError, OSError):
        return False
