"""The keys of messages, and the names in them.

Identities have chunks of their own, so that access control can bind senders and repliers to keys.
"""

import re
from typing import Final

from msgspec import Struct

DOMAIN: Final = "trade"
"""The domain of the middleware's own functions."""
PROVIDER: Final = "system"
"""The provider of all of them except e-stops."""
ESTOP_PROVIDER: Final = "estops"
"""The provider of the functions for e-stops, in the same domain."""
CLOCK: Final = "clock"
GROUP: Final = re.compile(r"[A-Za-z0-9_-]{1,80}(\.[A-Za-z0-9_-]{1,80})*")
"""The name of a group."""
_CHUNK = re.compile(r"[A-Za-z0-9_.@:-]{1,80}")


def is_chunk(text: str) -> bool:
    """Whether a text is valid as one chunk of a key: no separator, no wildcard, not the reserved first ``@``."""
    return _CHUNK.fullmatch(text) is not None and not text.startswith("@")


def as_chunk(text: str) -> str:
    """The text with every character replaced that is invalid in a key."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text)[:80] or "_"


class Address(Struct, frozen=True, array_like=True, gc=False, cache_hash=True):
    """The address of a container: its identity, its name, and its boot."""

    identity: str
    container: str
    epoch: str

    def __str__(self) -> str:
        return f"{self.who}/{self.epoch}"

    @property
    def who(self) -> str:
        """The container's name in reports and messages, the same in every boot."""
        return f"{self.identity}/{self.container}"


class ServiceKey(Struct, frozen=True, array_like=True, gc=False, cache_hash=True):
    """The name of one service of one boot epoch; a handle in its wire form."""

    address: Address
    domain: str
    provider: str
    name: str

    def __str__(self) -> str:
        return f"{self.address}/{self.domain}/{self.provider}/{self.name}"


def call_key(caller: str, callee: Address, domain: str, provider: str, *, stop: bool) -> str:
    """The key of a call: stops have keys of their own, so that they never wait behind calls."""
    return f"{'stop' if stop else 'call'}/{caller}/{callee}/{domain}/{provider}"


def calls_to(callee: Address, *, stop: bool, caller: str = "*") -> str:
    """The key expression of all calls to a container, of one caller or of all."""
    return f"{'stop' if stop else 'call'}/{caller}/{callee}/**"


def reply_key(callee: str, caller: str, container: str, channel: str) -> str:
    """The key of the replies of an identity to one channel of a caller's container."""
    return f"reply/{callee}/{caller}/{container}/{channel}"


def registry_key(domain: str, address: Address, provider: str) -> str:
    """The key of a provider's entry in the registry."""
    return f"registry/{domain}/{address}/{provider}"


def alive_key(session: Address | str) -> str:
    """The key of a container's sign of life, or of a session's within it."""
    return f"alive/{session}"


BRIDGE: Final = "bridge"
"""The last chunk of a bridge's second sign of life; the sessions of clients have a dot in theirs."""


def bridge_key(address: Address) -> str:
    """The key of the sign of life that a bridge has as a bridge; the first to disappear when it leaves."""
    return alive_key(f"{address}/{BRIDGE}")


def estop_key(identity: str) -> str:
    """The key of e-stop orders of an identity, to which all containers subscribe."""
    return f"estop/{identity}"


def estop_confirmed_key(address: Address) -> str:
    """The key of a container's confirmations of e-stops."""
    return f"estop/{address}"


LOCAL: Final = "-local-"
"""Within the channel of a reply key: the answer goes to a connection of the local path."""

ESTOPS: Final = "estop/**"


TALLY: Final = "tally"
"""The last chunk of the key, in the middleware's own domain, under which a container publishes its revision."""


def tally_key(address: Address) -> str:
    """The key of a container's revision, in the middleware's own domain."""
    return registry_key("trade", address, TALLY)


REGISTRY: Final = "registry/**"
ALIVE: Final = "alive/**"

PASSING: Final = {REGISTRY: "registry/*/**", ESTOPS: "estop/*/**"}
"""Patterns to which all containers subscribe, and others that match the same keys: see `ZenohTransport.settle`."""


NO_GROUP: Final = "_"  # the domain of a provider without one


def domain_of(groups: tuple[str, ...]) -> str:
    """A provider's first group, whole, in one chunk: the unit of access rules and export lists."""
    return groups[0] if groups else NO_GROUP


def client_name(client: str) -> str:
    """A client's name as it is part of the name of its session."""
    return as_chunk(client)[:40]


def client_of(session: str) -> str:
    """``anna``, if a container acts for this client in the session; else empty."""
    client = session.split("/")[3:]
    return client[0].rpartition(".")[0] if client else ""
