"""The state of a CAN interface according to Linux: whether it is up, and its controller.

Sources: linux/rtnetlink.h, linux/if_link.h (the request, the attributes), linux/can/netlink.h (those of a controller).
"""

import socket
import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from trade_drivers.bus.can._errors import ErrorState

_HEADER: Final = struct.Struct("=IHHII")
_LINK: Final = struct.Struct("=BxHiII")
_ATTRIBUTE: Final = struct.Struct("=HH")
_NEW_LINK: Final = 16
_GET_LINK: Final = 18
_REQUEST: Final = 1
_UP: Final = 1
_QUEUE_LENGTH: Final = 13
_LINK_INFO: Final = 18
_INFO_DATA: Final = 2
_CAN_BIT_TIMING: Final = 1
_BITRATE_SIZE: Final = 4
"""The structure that begins with the bit rate."""
_CAN_STATE: Final = 4
_KIND_MASK: Final = 0x3FFF
"""The two bits above it are flags."""
_PATIENCE_S: Final = 1.0
_LONGEST: Final = 65_536


class Link(NamedTuple):
    """The state of an interface."""

    up: bool
    state: ErrorState | None
    """None if the interface has no controller (``vcan``) or is stopped."""
    bitrate: int | None = None
    """Bits per second; None if the interface has no controller, or no rate is set."""
    queue: int | None = None
    """Frames that its send queue holds: ``txqueuelen``."""


def look_at(channel: str) -> Link:
    """Queries the system; raises OSError if there is no such interface."""
    try:
        index = socket.if_nametoindex(channel)
    except OSError:
        raise OSError(f"there is no interface {channel}; `ip link` lists the interfaces") from None
    body = _LINK.pack(socket.AF_UNSPEC, 0, index, 0, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as system:
        system.settimeout(_PATIENCE_S)
        system.send(_HEADER.pack(_HEADER.size + len(body), _GET_LINK, _REQUEST, 0, 0) + body)
        answer = system.recv(_LONGEST)
    return parse_link(answer)


def parse_link(answer: bytes) -> Link:
    """Parses the system's answer; raises OSError for a refusal."""
    if len(answer) < _HEADER.size + _LINK.size or _HEADER.unpack_from(answer)[1] != _NEW_LINK:
        raise OSError("the system reports nothing about the interface")
    *_, flags, _ = _LINK.unpack_from(answer, _HEADER.size)
    attributes = answer[_HEADER.size + _LINK.size :]
    data = _within(_within(attributes, _LINK_INFO), _INFO_DATA)
    number = int.from_bytes(_within(data, _CAN_STATE) or b"\xff", "little")
    bitrate = int.from_bytes(_within(data, _CAN_BIT_TIMING)[:_BITRATE_SIZE], "little")
    length = _within(attributes, _QUEUE_LENGTH)
    queue = int.from_bytes(length, "little") if length else None
    return Link(bool(flags & _UP), ErrorState(number) if number in set(ErrorState) else None, bitrate or None, queue)


def _within(data: bytes, kind: int) -> bytes:
    """Returns the attribute of a kind; empty if there is none."""
    return next((value for found, value in _attributes(data) if found == kind), b"")


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, place)
        if length < _ATTRIBUTE.size:
            return
        yield kind & _KIND_MASK, data[place + _ATTRIBUTE.size : place + length]
        place += (length + 3) & ~3
