"""The bridge's node in ROS 2, and the endpoints of its topics and services."""

import itertools
import struct
import time
from typing import Final, NamedTuple

import zenoh

from trade_gateway.ros.ros2._hashes import Hashes
from trade_gateway.ros.ros2._link import Declaration, Link
from trade_gateway.ros.ros2._names import TokenKind, absolute, data_key, gid, node_token, token
from trade_gateway.ros.ros2._presence import Presence
from trade_gateway.ros_messages._types import Types

GID_BYTES: Final = 16
_FORMAT: Final = struct.Struct(f"<qqB{GID_BYTES}s")


class Attachment(NamedTuple):
    """The data attached to each message, request and response.

    Facts, from ros2/rmw_zenoh (``rmw_zenoh_cpp/src/detail/attachment_helpers.cpp`` since its change 601 of spring 2025)
    and zenoh's serialization format: sequence number and time in ns since 1970 as 64-bit little-endian integers, then
    the 16 bytes of the endpoint's gid with their number, one byte, before them. A response carries the sequence number
    and gid of its request, and a time of its own. Sequence numbers start at 1.
    """

    sequence: int
    time_ns: int
    gid: bytes

    def to_bytes(self) -> bytes:
        """Returns it as it travels."""
        return _FORMAT.pack(self.sequence, self.time_ns, GID_BYTES, self.gid)

    @classmethod
    def from_bytes(cls, data: bytes) -> "Attachment":
        """Parses a received attachment.

        Raises:
            ValueError: these bytes are not an attachment, or come from an older rmw_zenoh.
        """
        if len(data) != _FORMAT.size:
            raise ValueError(f"an attachment has {_FORMAT.size} bytes, not {len(data)}")
        sequence, time_ns, length, gid = _FORMAT.unpack(data)
        if length != GID_BYTES:
            raise ValueError(f"a gid has {GID_BYTES} bytes, not {length}")
        return cls(sequence, time_ns, gid)


USUAL: Final = "::,10:,:,:,,"
"""Reliable, volatile, keep last 10: the default of ROS 2 for topics and services."""
LATCHED: Final = ":1:,1:,:,:,,"
"""Reliable, transient local, keep last 1."""


class Endpoint(NamedTuple):
    """A publisher, subscription, service server or client of this node."""

    key: str
    token: str
    gid: bytes

    def attachment(self, sequence: int) -> bytes:
        """Returns the attachment of a message that is sent now."""
        return Attachment(sequence, time.time_ns(), self.gid).to_bytes()


class Sender:
    """The sender of something, by its attachment. It is looked up on arrival, as the sender may end soon."""

    def __init__(self, presence: Presence, attachment: "zenoh.ZBytes | None") -> None:
        self.attached: Final = None if attachment is None else _read(attachment)
        """None: there is no attachment, or it cannot be read."""
        self._presence = presence
        self._name = "" if self.attached is None else presence.known(self.attached.gid)

    def name(self, *, waits: bool = True) -> str:
        """The name of its node; empty if unknown. May wait shortly for it."""
        if self._name or self.attached is None:
            return self._name
        look = self._presence.node_of if waits else self._presence.known
        return look(self.attached.gid)


def _read(attachment: zenoh.ZBytes) -> Attachment | None:
    try:
        return Attachment.from_bytes(attachment.to_bytes())
    except ValueError:
        return None


class Node:
    """The node. Others see it as soon as there is a router."""

    def __init__(self, link: Link, domain_id: int, name: str, types: Types) -> None:
        """Raises ConfigurationError: this is not the name of a node."""
        self.name: Final = absolute(name)
        self.link: Final = link
        self.types: Final = types
        self.hashes: Final = Hashes(types)
        self.presence: Final = Presence(link, domain_id)
        self._domain_id = domain_id
        self._numbers = itertools.count(1)
        self._declared: Declaration = link.declare(self._declare)

    def topic(self, kind: TokenKind, name: str, type_name: str, qos: str) -> Endpoint:
        """A publisher or subscription. Raises ConfigurationError: its name or type is invalid."""
        return self._endpoint(kind, name, type_name, self.hashes.message(type_name), qos)

    def service(self, kind: TokenKind, name: str, type_name: str) -> Endpoint:
        """A service server or client. Raises ConfigurationError: its name or type is invalid."""
        return self._endpoint(kind, name, type_name, self.hashes.service(type_name), USUAL)

    def sender(self, attachment: "zenoh.ZBytes | None") -> Sender:
        """The sender of what has just arrived with this attachment. Does not wait."""
        return Sender(self.presence, attachment)

    def close(self) -> None:
        """Withdraws the node. Idempotent."""
        self.presence.close()
        self._declared.close()

    def _endpoint(self, kind: TokenKind, name: str, type_name: str, type_hash: str, qos: str) -> Endpoint:
        number = next(self._numbers)
        own = token(self._domain_id, self.link.id, number, kind, self.name, name, type_name, type_hash, qos)
        made = Endpoint(data_key(self._domain_id, name, type_name, type_hash), own, gid(own))
        self.presence.introduce(made.gid, self.name)
        return made

    def _declare(self, session: zenoh.Session) -> list[zenoh.LivelinessToken]:
        return [session.liveliness().declare_token(node_token(self._domain_id, self.link.id, self.name))]
