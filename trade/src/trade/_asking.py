"""Asking containers for what stands there, when something they announced may have been missed."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

from trade._registry import ContainerState, Registry
from trade._transport import Answer, ChannelClosed, Transport
from trade._wire import REGISTRY, Address, registry_key

_logger = logging.getLogger("trade")

_ANSWER_S: Final = 5.0
"""An answer that takes longer is none; who is lost meanwhile is not waited for."""
_FIRST_PAUSE_S: Final = 0.1
_LONGEST_PAUSE_S: Final = 5.0
"""Between two questions to a container that is alive and does not answer, or announces nonsense."""

Take = Callable[[Answer, dict[Address, ContainerState]], None]


class Asker:
    """One thread that asks; several requests for one container are one question.

    It also gives this container's own sign of how far it is, every ``Transport.beat_s``.
    """

    def __init__(self, transport: Transport, registry: Registry, take: Take, beat: Callable[[], None]) -> None:
        self._transport = transport
        self._registry = registry
        self._take = take
        self._beat = beat
        self._changed = threading.Condition()
        self._due: dict[Address, float] = {}
        """When to ask, in monotonic seconds."""
        self._pauses: dict[Address, float] = {}
        """Until it is asked again, of those whose last answer left something open."""
        self._asking = False
        self._closed = False
        self._next_beat = time.monotonic() + transport.beat_s
        self._thread = threading.Thread(target=self._run, name="trade-asking", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def request(self, address: Address, *, anew: bool = False) -> None:
        """Ask a container soon; does not wait.

        Args:
            address: whom.
            anew: it has just appeared: whatever was the matter before does not count.
        """
        with self._changed:
            if anew:
                self._pauses.pop(address, None)
                self._due.pop(address, None)
            self._due.setdefault(address, time.monotonic() + self._pauses.get(address, 0.0))
            self._changed.notify_all()

    @property
    def busy(self) -> bool:
        """Whether somebody is asked, or is to be asked without a pause."""
        with self._changed:
            return self._asking or any(address not in self._pauses for address in self._due)

    def _run(self) -> None:
        try:
            while not self._closed:
                if time.monotonic() >= self._next_beat:
                    self._next_beat = time.monotonic() + self._transport.beat_s
                    self._beat()
                self._ask(self._wait())
        except ChannelClosed:
            return

    def _wait(self) -> list[Address]:
        """Whom to ask now; nobody when it is time for something else."""
        with self._changed:
            self._asking = False
            soonest = min([self._next_beat, *self._due.values()])
            if not self._closed and (left := soonest - time.monotonic()) > 0:
                self._changed.wait(min(left, threading.TIMEOUT_MAX))
            now = time.monotonic()
            due = [address for address, when in self._due.items() if when <= now]
            for address in due:
                del self._due[address]
            self._asking = bool(due)
            return due

    def _ask(self, due: list[Address]) -> None:
        alive = {state.address: state for state in self._registry.containers()}
        open_ones = [address for address in due if address in alive and not alive[address].heard.complete]
        if 2 * len(open_ones) > len(alive):
            self._ask_with(REGISTRY, alive)
        else:
            for address in open_ones:
                self._ask_with(registry_key("*", address, "*"), {address: alive[address]})
        for address in due:
            self._look_after(address)

    def _ask_with(self, pattern: str, meant: dict[Address, ContainerState]) -> None:
        for answer in self._transport.ask(pattern, _ANSWER_S):
            try:
                self._take(answer, meant)
            except Exception:
                _logger.exception("the registry could not take an answer")

    def _look_after(self, address: Address) -> None:
        """Whoever is alive and left something open is asked again, less and less often."""
        left_open = self._registry.left_open(address)
        with self._changed:
            if left_open:
                pause_s = min(2 * self._pauses.get(address, _FIRST_PAUSE_S / 2), _LONGEST_PAUSE_S)
                self._pauses[address] = pause_s
                self._due[address] = time.monotonic() + pause_s
            else:
                self._pauses.pop(address, None)

    def close(self) -> None:
        """End the thread. Idempotent."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(2)
