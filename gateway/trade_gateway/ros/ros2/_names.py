"""Names of ROS 2 as keys of zenoh, in the notation of rmw_zenoh.

Facts, all from ros2/rmw_zenoh (``docs/design.md``, ``rmw_zenoh_cpp/src/detail/liveliness_utils.cpp``, ``qos.cpp``):

- Topics and services are at ``<domain>/<name without its first slash>/<DDS type>/<type hash>``; the DDS type of
  ``package/msg/Name`` is ``package::msg::dds_::Name_``.
- Liveliness tokens announce nodes: ``@ros2_lv/<domain>/<session>/<node id>/<entity id>/<kind>/<enclave>/
  <namespace>/<node>``, and endpoints add ``/<name>/<DDS type>/<type hash>/<QoS>``. In all of these a slash is
  written ``%``. Kinds are NN, MP, MS, SS, SC: node, publisher, subscription, service server and client.
- QoS is ``reliability:durability:history,depth:deadline:lifespan:liveliness``, each empty where it is the default:
  reliable, volatile, keep last, depth 42, no deadlines.
- An endpoint's gid is the XXH3-128 of its token, seed 0, its lower half first, both in little-endian order.
"""

import re
from enum import Enum
from typing import Final, NamedTuple

import xxhash

from trade.errors import ConfigurationError

_ADMIN: Final = "@ros2_lv"
_NAME: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE: Final = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")
_NODE_PARTS: Final = 9
_ENDPOINT_PARTS: Final = 13


class TokenKind(Enum):
    """Kind of a liveliness token."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"
    CLIENT = "SC"


class TokenContent(NamedTuple):
    """The content of a liveliness token."""

    session: str
    kind: TokenKind
    node: str
    """Fully qualified: ``/arm/teleop``."""
    name: str = ""
    """Name of the topic or service; a node has none."""


def absolute(name: str) -> str:
    """Returns a name of a topic, service, action or node unchanged.

    Raises:
        ConfigurationError: it is not an absolute name of ROS.
    """
    if _NAME.fullmatch(name) is None or "__" in name:
        raise ConfigurationError(where="ROS name", problem=f"{name!r} must be absolute, such as /like/this_1")
    return name


def dds_type(type_name: str) -> str:
    """``std_msgs/msg/String`` as ``std_msgs::msg::dds_::String_``. Raises ConfigurationError: it is not a type name."""
    found = _TYPE.fullmatch(type_name)
    if found is None:
        raise ConfigurationError(where="ROS type", problem=f"{type_name!r} must be written package/msg/Name")
    package, kind, name = found.groups()
    return f"{package}::{kind}::dds_::{name}_"


def data_key(domain_id: int, name: str, type_name: str, type_hash: str) -> str:
    """The key of a topic's messages or of a service's requests."""
    return f"{domain_id}/{absolute(name)[1:]}/{dds_type(type_name)}/{type_hash}"


def node_token(domain_id: int, session: str, node: str) -> str:
    """The token of the only node of a session."""
    return f"{_ADMIN}/{domain_id}/{session}/0/0/{TokenKind.NODE.value}/{_of_node(node)}"


def token(
    domain_id: int,
    session: str,
    number: int,
    kind: TokenKind,
    node: str,
    name: str,
    type_name: str,
    type_hash: str,
    qos: str,
) -> str:
    """The token of an endpoint; its number is unique within the session and not 0."""
    start = f"{_ADMIN}/{domain_id}/{session}/0/{number}/{kind.value}/{_of_node(node)}"
    return f"{start}/{_mangled(absolute(name))}/{dds_type(type_name)}/{type_hash}/{qos}"


def every_token(domain_id: int) -> str:
    """Matches all tokens of a domain."""
    return f"{_ADMIN}/{domain_id}/**"


def read_token(key: str) -> TokenContent | None:
    """Parses a token; None if it is not of rmw_zenoh. Ignores parts that a later version appends."""
    parts = key.split("/")
    if len(parts) < _NODE_PARTS or parts[0] != _ADMIN:
        return None
    try:
        kind = TokenKind(parts[5])
    except ValueError:
        return None
    if kind is not TokenKind.NODE and len(parts) < _ENDPOINT_PARTS:
        return None
    namespace, node = (part.replace("%", "/") for part in parts[7:9])
    name = "" if kind is TokenKind.NODE else parts[9].replace("%", "/")
    return TokenContent(parts[2], kind, f"{namespace.rstrip('/')}/{node}", name)


def gid(endpoint_token: str) -> bytes:
    """The 16 bytes that an endpoint puts into each message."""
    return xxhash.xxh3_128_intdigest(endpoint_token.encode()).to_bytes(16, "little")


def _of_node(node: str) -> str:
    namespace, _, name = absolute(node).rpartition("/")
    return f"%/{_mangled(namespace or '/')}/{name}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
