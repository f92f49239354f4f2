"""The container under test in one boot: its process, its sign of life, and what it offers."""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from trade.protocol.keys import Address, registry_key
from trade.protocol.messages import Malformed, ProviderInfo, decode_provider, decode_tally
from trade.transport.base import Answer
from trade_checks.conformance._assertions import NotHeld, eventually, require
from trade_checks.conformance._raw_client import SYSTEM, Place

GROUP: Final = "peer"
_OFFERED_S: Final = 5.0
_GOODBYE_S: Final = 5.0
_LOOK_S: Final = 0.02


class RegistryReply(Struct, frozen=True):
    """A container's answer to the registry query."""

    entries: dict[Place, ProviderInfo]
    tally: int
    """The revision of this answer; -1: it gives none."""
    last: str
    """The last chunk of the last key in the answer."""
    keys: tuple[str, ...]


class Peer:
    """The container under test, in one of its boots."""

    def __init__(
        self,
        process: "subprocess.Popen[bytes]",
        address: Address,
        ask: Callable[[str], list[Answer]],
        seen: Callable[[Address], bool],
    ) -> None:
        self._ask = ask
        self._seen = seen
        self.process: Final = process
        self.address: Final = address
        self._places: dict[str, Place] = {}

    @property
    def alive(self) -> bool:
        """Whether its process runs and has a sign of life."""
        return self.process.poll() is None and self._seen(self.address)

    def signal(self, number: int) -> None:
        """Sends a signal to the process and all that it started, if any of them is left."""
        signal_group(self.process, number)

    @property
    def arm(self) -> Place:
        """The domain and provider of its arm."""
        return self.place("turn")

    def place(self, service: str) -> Place:
        """The provider of a service in group ``peer``; raises NotHeld if there is none."""
        if service not in self._places:  # it may take a moment before everything is offered
            eventually(lambda: self._learn(service), f"it offers no {service} in the group {GROUP}", _OFFERED_S)
        return self._places[service]

    def _learn(self, wanted: str) -> bool:
        for place, info in self.offer().entries.items():
            if place[0] == GROUP:
                self._places.update((one.name, place) for one in info.services)
        return wanted in self._places

    def offer(self) -> RegistryReply:
        """Queries what it offers; raises NotHeld without an answer."""
        found = self._ask(registry_key("*", self.address, "*"))
        require(found, "it does not answer the registry query")
        return _offer(found[0])

    def has_function(self, name: str) -> bool:
        """Whether its own provider has that function."""
        own = self.offer().entries.get(SYSTEM)
        return own is not None and any(service.name == name for service in own.services)


def signal_group(process: "subprocess.Popen[bytes]", number: int) -> bool:
    """Sends a signal to a process with its own session, and all that it started. Returns whether any is left."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # the latter: those left have ended, unreaped
        os.killpg(process.pid, number)
        return True
    return False


def end_group(process: "subprocess.Popen[bytes]") -> None:
    """Ends a process and all that it started, by force if necessary."""
    until = time.monotonic() + _GOODBYE_S
    try:
        signal_group(process, signal.SIGTERM)
        signal_group(process, signal.SIGCONT)  # a frozen process handles no signal
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GOODBYE_S)
        while signal_group(process, 0) and time.monotonic() < until:  # a shell may end before what it started
            threading.Event().wait(_LOOK_S)
    finally:
        signal_group(process, signal.SIGKILL)
    process.wait()


def _offer(answer: Answer) -> RegistryReply:
    entries: dict[Place, ProviderInfo] = {}
    tally = -1
    for message in answer.messages:
        _, domain, *_, provider = message.key.split("/")
        try:
            if (domain, provider) == ("trade", "tally"):
                tally = decode_tally(message.payload or b"").revision
            else:
                entries[domain, provider] = decode_provider(message.payload or b"")
        except Malformed as bad:
            raise NotHeld(f"the entry of {domain}/{provider} cannot be read: {bad}") from None
    keys = tuple(message.key for message in answer.messages)
    return RegistryReply(entries, tally, keys[-1].rpartition("/")[2], keys)
