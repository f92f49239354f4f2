"""The container under test, in one of its boots: whether it is there, and what it says that it offers."""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from trade._protocol.keys import Address, registry_key
from trade._protocol.messages import Malformed, ProviderInfo, decode_provider, decode_tally
from trade._transport.base import Answer
from trade_gateway.conformance._assertions import NotHeld, eventually, require
from trade_gateway.conformance._raw_client import SYSTEM, Place

GROUP: Final = "peer"
_OFFERED_S: Final = 5.0
_GOODBYE_S: Final = 5.0
_LOOK_S: Final = 0.02


class Offer(Struct, frozen=True):
    """What a container answers when it is asked what it offers."""

    entries: dict[Place, ProviderInfo]
    tally: int
    """The revision as of which that is; -1: it does not say."""
    last: str
    """The last chunk of the key that was told last."""
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
        """Whether its process runs and its sign of life stands."""
        return self.process.poll() is None and self._seen(self.address)

    def signal(self, number: int) -> None:
        """Tell the process and all that it started; nothing if none of them is left."""
        signal_group(self.process, number)

    @property
    def arm(self) -> Place:
        """Where its arm is."""
        return self.place("turn")

    def place(self, service: str) -> Place:
        """Who in group ``peer`` offers a service of that name; raises NotHeld if nobody does."""
        if service not in self._places:  # it may be a moment before all is offered
            eventually(lambda: self._learn(service), f"it offers no {service} in the group {GROUP}", _OFFERED_S)
        return self._places[service]

    def _learn(self, wanted: str) -> bool:
        for place, info in self.offer().entries.items():
            if place[0] == GROUP:
                self._places.update((one.name, place) for one in info.services)
        return wanted in self._places

    def offer(self) -> Offer:
        """Ask what it offers; raises NotHeld if that is not answered."""
        found = self._ask(registry_key("*", self.address, "*"))
        require(found, "it does not answer the question what it offers")
        return _offer(found[0])

    def says(self, name: str) -> bool:
        """Whether its own provider has that function."""
        own = self.offer().entries.get(SYSTEM)
        return own is not None and any(service.name == name for service in own.services)


def signal_group(process: "subprocess.Popen[bytes]", number: int) -> bool:
    """A signal for a process begun in a session of its own, and all that it started. Returns whether any is left."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # the latter: those left have ended, unreaped
        os.killpg(process.pid, number)
        return True
    return False


def end_group(process: "subprocess.Popen[bytes]") -> None:
    """Ask a process and all that it started to end, and see to it that they do."""
    until = time.monotonic() + _GOODBYE_S
    try:
        signal_group(process, signal.SIGTERM)
        signal_group(process, signal.SIGCONT)  # what stands still hears nothing
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GOODBYE_S)
        while signal_group(process, 0) and time.monotonic() < until:  # a shell may end before what it started
            threading.Event().wait(_LOOK_S)
    finally:
        signal_group(process, signal.SIGKILL)
    process.wait()


def _offer(answer: Answer) -> Offer:
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
            raise NotHeld(f"what it tells of {domain}/{provider} cannot be read: {bad}") from None
    keys = tuple(message.key for message in answer.messages)
    return Offer(entries, tally, keys[-1].rpartition("/")[2], keys)
