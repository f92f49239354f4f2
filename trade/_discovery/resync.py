"""Queries containers for their current announcements when one may have been missed."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from trade._registry.registry import ContainerState, Registry
from trade._threads.scheduler import NEVER, Scheduler
from trade.protocol.keys import Address, registry_key
from trade.transport.base import Answer, ChannelClosed, Transport

_logger = logging.getLogger("trade")

_ANSWER_S: Final = 1.5
"""A reply that takes longer counts as missing at first. A container that starts waits longer than this for all."""
_SLOW_ANSWER_S: Final = 10.0
"""The timeout for a container that has not replied in time before; it is queried apart from the others."""
_FIRST_PAUSE_S: Final = 0.1
_LONGEST_PAUSE_S: Final = 5.0
"""Between two queries to a container that is alive and does not reply, or announces nonsense."""
_AT_ONCE: Final = 16
"""The most containers that are queried at the same time: what all have is megabytes, and a hub that cannot pass them on
at once passes nothing else on meanwhile."""
_INTRODUCTION_S: Final = 0.00125
"""For each known container: how long after its sign of life one behind a hub announces all that it has. Others query it
only after twice this time, if they missed some: it cannot answer all of them while it reads what they offer."""
_END_S: Final = 2.0

Take = Callable[[Answer, dict[Address, ContainerState]], None]


def introduction_s(registry: Registry) -> float:
    """How long after its sign of life a container behind a hub announces all that it has, by what this one knows."""
    return _INTRODUCTION_S * len(registry.containers())


class Resynchronizer:
    """A task that sends queries; several requests for one container make one query.

    A second task queries slow containers, so that no other waits for them. The first one also calls `beat`, every
    ``Transport.beat_s``, to announce the container's own revision.
    """

    def __init__(
        self,
        transport: Transport,
        registry: Registry,
        take: Take,
        beat: Callable[[], None],
        timers: Scheduler,
    ) -> None:
        self._transport = transport
        self._registry = registry
        self._take = take
        self._beat = beat
        self._clock = timers.clock
        self._changed = threading.Condition()
        self._due: dict[Address, float] = {}
        """When to query each container, in seconds of the clock."""
        self._pauses: dict[Address, float] = {}
        """Seconds until the next query, of those whose last reply was missing or incomplete."""
        self._slow: set[Address] = set()
        """Containers whose last reply did not come in time."""
        self._asking = False
        self._closed = False
        self._next_beat = self._clock.now() + transport.beat_s
        self._tasks = {slow: timers.due(partial(self._run, slow)) for slow in (False, True)}
        self._started = False

    def start(self) -> None:
        self._started = True
        self._remind()

    def _remind(self) -> None:
        """Runs each task when its next work is due, which may have changed."""
        for slow, task in self._tasks.items() if self._started else ():
            task.by(self._next_ns(slow))

    def _next_ns(self, slow: bool) -> float:
        with self._changed:
            soonest = min(self._mine(slow).values(), default=NEVER)
            return NEVER if self._closed else (soonest if slow else min(soonest, self._next_beat)) * 1e9

    def request(self, address: Address, *, appeared: bool = False) -> None:
        """Schedule a query to a container; does not wait.

        Args:
            address: the container.
            appeared: whether it has just appeared, so that earlier failures do not count.
        """
        with self._changed:
            if appeared:
                self._due.pop(address, None)
                self._forget(address)
            first_s = 2 * introduction_s(self._registry) if appeared and self._introduce_themselves else 0.0
            pause_s = self._pauses.get(address, first_s)
            self._due.setdefault(address, self._clock.now() + pause_s)
        self._remind()

    @property
    def _introduce_themselves(self) -> bool:
        """Whether containers that appear now announce all that they have."""
        return self._transport.relayed and self._started

    @property
    def busy(self) -> bool:
        """Whether a query is pending or running, other than to containers that failed to reply."""
        with self._changed:
            return not self._closed and (self._asking or any(address not in self._pauses for address in self._due))

    def wait(self, timeout_s: float) -> None:
        """Wait until no query is pending."""
        with self._changed:
            self._changed.wait_for(lambda: not self.busy, timeout_s)

    def _run(self, slow: bool) -> None:
        try:
            if not slow:
                self._beat_if_due()
            self._ask(self._take_due(slow), slow)
        except ChannelClosed:
            self._closed = True
        except Exception:
            _logger.exception("the query for current announcements failed")
        with self._changed:
            if not slow:
                self._asking = False
            self._changed.notify_all()
        self._remind()

    def _beat_if_due(self) -> None:
        if self._clock.now() >= self._next_beat:
            self._next_beat = self._clock.now() + self._transport.beat_s
            self._beat()

    def _take_due(self, slow: bool) -> list[Address]:
        """The containers to query now."""
        with self._changed:
            now = self._clock.now()
            due = [address for address, when in self._mine(slow).items() if when <= now]
            for address in due:
                del self._due[address]
            self._asking = self._asking if slow else bool(due)
            return due

    def _mine(self, slow: bool) -> dict[Address, float]:
        return {address: when for address, when in self._due.items() if (address in self._slow) is slow}

    def _ask(self, due: list[Address], slow: bool) -> None:
        alive = {state.address: state for state in self._registry.containers()}
        open_ones = [address for address in due if address in alive and not alive[address].heard.complete]
        for first in range(0, len(open_ones), _AT_ONCE):
            self._ask_these(open_ones[first : first + _AT_ONCE], alive, _SLOW_ANSWER_S if slow else _ANSWER_S)
        with self._changed:
            for address in set(due).difference(open_ones):
                self._forget(address)

    def _ask_these(self, asked: Sequence[Address], alive: dict[Address, ContainerState], patience_s: float) -> None:
        before, began = {address: alive[address].heard.answered for address in asked}, time.monotonic()
        answers = self._transport.ask([registry_key("*", address, "*") for address in asked], patience_s)
        in_vain = time.monotonic() - began >= _ANSWER_S
        for answer in answers:
            try:
                self._take(answer, alive)
            except Exception:
                _logger.exception("the registry could not take an answer")
        left_open = [address for address in asked if self._registry.left_open(address)]
        with self._changed:
            for address in asked:
                if address not in left_open:
                    self._forget(address)
                elif alive[address].heard.answered > before[address]:  # more has been missed meanwhile
                    self._forget(address)
                    self._due[address] = self._clock.now()
                else:
                    self._put_off(address, in_vain)
            self._changed.notify_all()

    def _forget(self, address: Address) -> None:
        """Forget that a container ever failed to reply."""
        self._pauses.pop(address, None)
        self._slow.discard(address)

    def _put_off(self, address: Address, in_vain: bool) -> None:
        """Query a container that is alive but does not reply less and less often."""
        pause_s = min(2 * self._pauses.get(address, _FIRST_PAUSE_S / 2), _LONGEST_PAUSE_S)
        self._pauses[address] = pause_s
        self._due[address] = self._clock.now() + pause_s
        if in_vain:
            self._slow.add(address)

    def close(self) -> None:
        """Ask no more. Idempotent."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for task in self._tasks.values():
            task.cancel(_END_S)
