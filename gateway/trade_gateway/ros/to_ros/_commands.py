"""Messages of a ROS node as calls of TRADE services: the newest counts, and silence stops the motion.

A commanding node holds the lock of what it moves from its first message on. The lock is released when the node is
silent for the deadman's time, when it ends, and when a call fails: in each case after the stop is called.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Final, NamedTuple

from trade import Constraint, Container, Handle, Run, where
from trade.errors import ConfigurationError, TradeError
from trade_gateway.clients._clients import Client
from trade_gateway.ros._file import Command
from trade_gateway.ros._graph import Closable, Graph
from trade_gateway.ros._mapping_sync import Place, absent_name, named_services, of_name
from trade_gateway.ros._nodes import NodeClient, Nodes
from trade_gateway.ros_messages._conversion import RequestMapping, failure
from trade_gateway.ros_messages._types import Message

_logger = logging.getLogger("trade")

_MOST_UNDER_WAY: Final = 2
"""The running call and the one that replaces it; a newer command waits in a queue of one."""
_STOPPED_WITHIN_S: Final = 5.0
_SAID_AGAIN_S: Final = 10.0


class CommandsToRos:
    """``[[to_ros.command]]``."""

    def __init__(
        self, entry: Command, graph: Graph, nodes: Nodes, container: Container, say: Callable[[str], object]
    ) -> None:
        """Raises ConfigurationError: the type is not known."""
        self._entry = entry
        self._graph = graph
        self._nodes = nodes
        self._container = container
        self._say = say
        graph.types.fields(entry.type)

    @property
    def of(self) -> Constraint:
        return of_name(self._entry.service)

    @property
    def absent(self) -> tuple[str, str]:
        return absent_name(self._entry.service, f"topic {self._entry.topic}")

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        for handle in named_services(self._entry.service, found):
            yield Place("command", self._entry.topic), handle

    def open(self, place: Place, handle: Handle) -> Closable:
        entry = self._entry
        if handle.effect == "stop":
            problem = "is a stop, which any node may call at any time; a topic accepts one node. Use [[to_ros.service]]"
            raise ConfigurationError(where=handle.label, problem=problem)
        request_mapping = RequestMapping(self._graph.types, entry.type, handle, entry.args, entry.fixed)
        stops = stops_of(self._container, handle) if handle.effect == "actuate" else []
        if handle.effect == "actuate" and not stops:
            problem = "has no stop, so silence could not end a command's motion"
            raise ConfigurationError(where=handle.label, problem=problem)
        executor = _TopicExecutor(entry, handle, request_mapping, stops, self._nodes, self._say)
        try:
            executor.set_subscription(self._graph.subscribe(place.name, entry.type, executor.on_message))
        except BaseException:
            executor.close()
            raise
        return executor


class _Command(NamedTuple):
    """A waiting message."""

    message: Message
    node_name: str
    at: float
    admitted: int | None
    """The number of stops that its node had requested before."""


class _TopicExecutor:
    """Executes the messages of one topic, from one node at a time."""

    def __init__(
        self,
        entry: Command,
        handle: Handle,
        request_mapping: RequestMapping,
        stops: Sequence[Handle],
        nodes: Nodes,
        say: Callable[[str], object],
    ) -> None:
        self._entry = entry
        self._handle = handle
        self._request_mapping = request_mapping
        self._stops = stops
        self._nodes = nodes
        self._say = say
        self._changed = threading.Condition()
        self._newest: _Command | None = None
        self._owner: str | None = None
        self._last_message_at = 0.0
        self._closing = False
        self._guest: NodeClient | None = None
        self._watched: Client | None = None
        """The client whose end wakes the thread."""
        self._held_locks = ExitStack()
        self._runs: list[Run] = []
        self._problem = ("", 0.0)
        self._subscription: Closable | None = None
        self._thread = threading.Thread(target=self._run, name="trade-ros-command", daemon=True)
        self._thread.start()

    def set_subscription(self, subscription: Closable) -> None:
        """Sets the subscription that delivers the messages."""
        self._subscription = subscription

    def on_message(self, message: Message, node_name: str) -> None:
        """Queues a message. Does not wait."""
        with self._changed:
            if self._owner not in (None, node_name):
                self._report(
                    f"{node_name or 'another node'} is refused on {self._entry.topic}: {self._owner} commands there"
                )
                return
            self._owner, self._last_message_at = node_name, time.monotonic()
            guest = self._guest
            number = None if guest is None or guest.who != node_name else guest.client.admit(self._handle)
            self._newest = _Command(message, node_name, self._last_message_at, number)
            self._changed.notify()

    # --- its thread

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._ready, self._left_s())
                if self._closing:
                    break
                newest = self._newest if self._may_begin() else None
                self._newest = None if newest is not None else self._newest
                reason = self._end_reason()
            try:
                if reason:
                    self._end(reason)
                elif newest is not None:
                    self._begin(newest)
            except Exception as error:  # noqa: BLE001 - whatever went wrong, the motion must end
                self._end(f"{self._entry.topic}: {failure(error)}")
        self._end(f"{self._entry.topic} is not mapped any more")

    def _ready(self) -> bool:
        return self._closing or bool(self._end_reason()) or (self._newest is not None and self._may_begin())

    def _left_s(self) -> float | None:
        """Remaining time until the silence is too long."""
        if self._owner is None:
            return None
        return max(0.0, self._last_message_at + self._entry.deadman_s - time.monotonic())

    def _may_begin(self) -> bool:
        self._runs = [run for run in self._runs if not run.done()] + [run for run in self._runs[-1:] if run.done()]
        return sum(not run.done() for run in self._runs) < _MOST_UNDER_WAY

    def _end_reason(self) -> str:
        """Why the commanding node's turn ends; empty if it continues."""
        if self._owner is None:
            return ""
        if time.monotonic() - self._last_message_at >= self._entry.deadman_s:
            return f"no message on {self._entry.topic} for {self._entry.deadman_s:g} s"
        if self._guest is not None and self._guest.client.closed:
            return f"{self._guest.named} is gone"
        if self._runs and self._runs[-1].done() and (error := self._runs[-1].exception(0)) is not None:
            return f"{self._entry.topic}: {failure(error)}"
        return ""

    def _begin(self, command: _Command) -> None:
        """Calls the service with a command; an error ends the node's turn."""
        if time.monotonic() - command.at >= self._entry.deadman_s:
            return
        guest = self._nodes.guest(command.node_name, command.at)
        if self._handle.effect == "actuate" and self._guest is not guest:
            self._held_locks.close()
            hold = guest.grips.hold([self._handle], f"commands of {guest.named} on {self._entry.topic}", 0.0)
            self._held_locks.enter_context(hold)
        if self._guest is not guest:
            self._guest = guest
            if self._watched is not guest.client:
                self._watched = guest.client
                guest.client.when_closed(self._wake)
        words, deadline_s = self._request_mapping(command.message), self._entry.deadline_s
        run = guest.begin(self._handle, words, deadline_s, command.at, command.admitted)
        self._runs.append(run)
        run.add_done_callback(lambda _: self._wake())

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify()

    def _end(self, reason: str) -> None:
        """Stops the motion, then releases the lock."""
        with self._changed:
            guest, self._guest, self._owner = self._guest, None, None
            moved, self._runs, self._newest = bool(self._runs), [], None
        if moved and guest is not None and not guest.client.closed:
            self._stop(guest, reason)
        try:
            self._held_locks.close()
        except TradeError as error:
            _logger.warning("the lock for %s could not be released: %s", self._entry.topic, error)
        if not self._closing:
            self._report(reason if not moved or guest is None else f"{reason}; {self._handle.label} was stopped")

    def _stop(self, guest: NodeClient, reason: str) -> None:
        runs: list[Run] = []
        for stop in self._stops:
            try:
                runs.append(guest.begin(stop, {}, _STOPPED_WITHIN_S, None))
            except TradeError:
                _logger.exception("%s; %s could not be called", reason, stop.label)
        for run in runs:
            try:
                run.result(_STOPPED_WITHIN_S)
            except Exception:
                _logger.exception("%s; it was not stopped", reason)
                guest.client.close()

    def _report(self, problem: str) -> None:
        """Reports a problem; repeats it only after some seconds."""
        before, said_at = self._problem
        if problem != before or time.monotonic() - said_at > _SAID_AGAIN_S:
            self._problem = (problem, time.monotonic())
            self._say(problem)

    def close(self) -> None:
        """Stops its motion and ends. Idempotent."""
        if self._subscription is not None:
            self._subscription.close()
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()


def stops_of(container: Container, handle: Handle) -> list[Handle]:
    """The stops of a service's provider."""
    key = handle.key
    siblings = container.services(where(container=handle.container))
    own = [one for one in siblings if one.effect == "stop" and one.key.address == key.address]
    return [one for one in own if (one.key.domain, one.key.provider) == (key.domain, key.provider)]
