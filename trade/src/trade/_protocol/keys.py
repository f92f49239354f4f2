"""Who and what stands in the keys of messages, and how keys are made of that.

Identities stand in chunks of their own, so that access control can pin who speaks and who answers.
"""

import re
from typing import Final

from msgspec import Struct

DOMAIN: Final = "trade"
"""The domain of the middleware's own functions."""
PROVIDER: Final = "system"
"""The provider of all of them but e-stops."""
ESTOP_PROVIDER: Final = "estops"
"""The provider of what has to do with e-stops, in the same domain."""
CLOCK: Final = "clock"
GROUP: Final = re.compile(r"[A-Za-z0-9_-]{1,80}(\.[A-Za-z0-9_-]{1,80})*")
"""The name of a group."""
_CHUNK = re.compile(r"[A-Za-z0-9_.@:-]{1,80}")


def is_chunk(text: str) -> bool:
    """Whether the text can stand as one chunk of a key: no separator, no wildcard, not the reserved first ``@``."""
    return _CHUNK.fullmatch(text) is not None and not text.startswith("@")


def as_chunk(text: str) -> str:
    """The text with everything replaced that cannot stand in a key."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text)[:80] or "_"


class Address(Struct, frozen=True, array_like=True, gc=False, cache_hash=True):
    """Where a container is: who speaks, under which name, in which boot."""

    identity: str
    container: str
    epoch: str

    def __str__(self) -> str:
        return f"{self.who}/{self.epoch}"

    @property
    def who(self) -> str:
        """The container, whichever boot of it: as reports and messages tell it."""
        return f"{self.identity}/{self.container}"


class ServiceKey(Struct, frozen=True, array_like=True, gc=False, cache_hash=True):
    """Names one service of one boot epoch; what a handle is over the wire."""

    address: Address
    domain: str
    provider: str
    name: str


def call_key(caller: str, callee: Address, domain: str, provider: str, *, stop: bool) -> str:
    return f"{'stop' if stop else 'call'}/{caller}/{callee}/{domain}/{provider}"


def calls_to(callee: Address, *, stop: bool, caller: str = "*") -> str:
    return f"{'stop' if stop else 'call'}/{caller}/{callee}/**"


def reply_key(callee: str, caller: str, container: str, channel: str) -> str:
    return f"reply/{callee}/{caller}/{container}/{channel}"


def registry_key(domain: str, address: Address, provider: str) -> str:
    return f"registry/{domain}/{address}/{provider}"


def alive_key(session: Address | str) -> str:
    """Of a container, or of a session within one."""
    return f"alive/{session}"


def estop_key(identity: str) -> str:
    """Orders of whoever speaks as that identity, for everybody."""
    return f"estop/{identity}"


def estop_confirmed_key(address: Address) -> str:
    return f"estop/{address}"


ESTOPS: Final = "estop/**"


TALLY: Final = "tally"
"""The last chunk of the key, in the middleware's own domain, under which a container says how far it is."""


def tally_key(address: Address) -> str:
    return registry_key("trade", address, TALLY)


REGISTRY: Final = "registry/**"
ALIVE: Final = "alive/**"

PASSING: Final = {REGISTRY: "registry/*/**", ESTOPS: "estop/*/**"}
"""What everybody subscribes to, and other patterns that match the same keys: see `ZenohTransport.settle`."""


NO_GROUP: Final = "_"  # the domain of a provider without one


def domain_of(groups: tuple[str, ...]) -> str:
    """A provider's first group, whole, in one chunk: the grain of access rules and export lists."""
    return groups[0] if groups else NO_GROUP
