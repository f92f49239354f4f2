"""The caller's end of the local path: connections to the containers of this host.

A call that is waited for borrows a connection for itself; started calls to one container share one. Any failure of a
connection sends its calls again on the transport, which decides what became of them.
"""

import itertools
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from trade._calls.slot import Slot
from trade.errors import TradeError
from trade.protocol.keys import LOCAL, Address
from trade.transport.host_socket import dial_on_host, host_sockets
from trade.transport.local_connection import ConnectionEnded, LocalConnection
from trade.transport.local_greeting import Passport

_logger = logging.getLogger("trade")

MARK: Final = ".calls-"
"""The first part of the names of sockets for calls."""
_MOST_FREE: Final = 32
"""Free connections that are kept. A program with as many threads that call opens no new one for each call."""
_GREETING_S: Final = 0.5
_SENDING_S: Final = 1.0
"""How long a call waits for the one before it to be sent."""
_OF_THE_TIME: Final = 0.25
"""The part of a call's time that each step of a greeting may take; the transport has the rest."""
_AGAIN_S: Final = 1.0


class LocalSlot(Slot):
    """A connection that one caller at a time borrows."""

    __slots__ = ("answered", "connection", "name", "offered", "stops", "whole")

    def __init__(self, name: str, connection: LocalConnection, *, stops: bool, offered: bool) -> None:
        super().__init__()
        self.name = name
        self.connection = connection
        self.stops = stops
        self.offered = offered
        """Whether the other end could have a shared segment."""
        self.answered = False
        """Whether the other end has answered a call on it, and so takes calls."""
        self.whole = True
        """Whether the next call may use it, as nothing of the last one is left on it."""

    def end(self, call_id: int, status: int) -> None:
        """Ends the wait for a call: its thread finds the connection broken."""
        self.ended_status = status
        self.ended_id = call_id
        self.connection.break_off()


class LocalStarter:
    """The connection for started calls to one container: many at a time, in the order in which they were started."""

    def __init__(self, peer: "LocalPeer", slot: LocalSlot) -> None:
        self.name = slot.name
        self.stops: Final = slot.stops
        """Whether it is for stops."""
        self._peer = peer
        self._slot = slot
        self._sending = threading.Lock()
        self._ended = False

    def send(self, data: bytes, key: bytes) -> None:
        """Sends a call. Raises ConnectionEnded: it may have been sent."""
        if not self._sending.acquire(timeout=_SENDING_S):
            raise ConnectionEnded
        try:
            if self._ended:
                raise ConnectionEnded
            self._slot.connection.send(data, key=key)
        except BaseException:
            self._slot.connection.break_off()  # half a call may be on it
            raise
        finally:
            self._sending.release()

    def break_off(self) -> None:
        """Ends the connection for both ends, from any thread."""
        self._slot.connection.break_off()

    def receive(self) -> bytes:
        """Waits for the next reply. Raises ConnectionEnded, Malformed."""
        _, payload = self._slot.connection.receive()
        self._slot.answered = True
        return payload

    @property
    def ended_there(self) -> bool:
        """Whether the other end has broken the connection off. Only for the thread that receives."""
        return self._slot.connection.ended_there

    def end(self) -> None:
        """Sends nothing more; closes the connection. Only for the thread that receives."""
        self._slot.connection.break_off()  # a thread may be sending
        with self._sending:
            self._ended = True
        self._peer.forget(self)
        self._slot.whole = False
        self._peer.take_back(self._slot)


class LocalPath:
    """The connections of one container to others on its host.

    Args:
        system: its system.
        passport: what it proves its identity with.
    """

    def __init__(self, system: str, passport: Passport) -> None:
        self._system = system
        self.passport: Final = passport
        self.slots: Final[set[LocalSlot]] = set()
        """All connections."""
        self._number = itertools.count().__next__
        self.closed = False

    def to(self, address: Address) -> "LocalPeer":
        """The connections to one container, which may be on another host."""
        return LocalPeer(self, address)

    def place_of(self, address: Address) -> Path | None:
        """The socket of a container; None if it has none on this host. Raises OSError, ConfigurationError."""
        return next(iter(host_sockets(self._system, MARK, address.epoch)), None)

    def abandon(self) -> None:
        """Lets go of all connections in a forked child."""
        self.closed = True
        for slot in self.slots:
            slot.connection.abandon()

    def new_name(self) -> str:
        """A reply key's ``container/channel`` that no other connection has."""
        own = self.passport.own
        return f"{own.container}/{own.epoch}{LOCAL}{self._number()}"

    def close(self) -> None:
        """Ends all connections. Idempotent."""
        self.closed = True
        for slot in list(self.slots):
            slot.connection.break_off()


class LocalPeer:
    """The connections to one container."""

    def __init__(self, path: LocalPath, address: Address) -> None:
        self._path = path
        self._address = address
        self._free: list[LocalSlot] = []
        self._free_for_stops: list[LocalSlot] = []
        self._starters: dict[bool, LocalStarter] = {}
        """The connections for started calls: that for stops, and that for all others."""
        self._opening = {False: threading.Lock(), True: threading.Lock()}
        self._place: Path | None = None
        self._not_before_s = 0.0
        """When to try again, after it could not be reached."""
        self._large = False
        """Whether large payloads pass, for which further connections have a shared segment."""
        self._closed = False

    def borrow(self, deadline_ns: int, *, stops: bool) -> LocalSlot | None:
        """A connection for one call; None if the container cannot be reached so in time. `take_back` it."""
        try:
            return (self._free_for_stops if stops else self._free).pop()
        except IndexError:
            return self._open(deadline_ns, stops=stops)

    def starter(self, deadline_ns: int, *, stops: bool, begin: Callable[[LocalStarter], None]) -> LocalStarter | None:
        """The connection for started calls; None if the container cannot be reached so in time.

        Args:
            deadline_ns: that of the call.
            stops: whether the calls are stops.
            begin: starts a thread that receives on a new one.
        """
        found = self._starters.get(stops)
        if found is not None:
            return found
        with self._opening[stops]:
            found = self._starters.get(stops)
            if found is not None or (slot := self._open(deadline_ns, stops=stops, shared=True)) is None:
                return found
            starter = LocalStarter(self, slot)
            try:
                begin(starter)
            except BaseException as problem:
                slot.whole = False
                self.take_back(slot)
                if isinstance(problem, RuntimeError):  # the process may have no more threads
                    return None
                raise
            self._starters[stops] = starter
            if self._closed:  # meanwhile
                starter.break_off()
            return starter

    def starts(self) -> bool:
        """Whether started calls take a connection now."""
        return False in self._starters

    def forget(self, starter: LocalStarter) -> None:
        """Opens another one for the next started call."""
        with self._opening[starter.stops]:
            if self._starters.get(starter.stops) is starter:
                del self._starters[starter.stops]

    def _open(self, deadline_ns: int, *, stops: bool, shared: bool = False) -> LocalSlot | None:
        limit_s = min(_GREETING_S, (deadline_ns - time.monotonic_ns()) / 1e9 * _OF_THE_TIME)
        if self._closed or self._path.closed or limit_s <= 0 or time.monotonic() < self._not_before_s:
            return None
        name, passport, large = self._path.new_name(), self._path.passport, self._large and not (stops or shared)
        try:
            place = self._find()
            if place is None:
                return None
            sock = dial_on_host(place, 0.0)  # a full queue is a reason for the transport, not for waiting
            connection = passport.greet(
                sock, self._address, name, stops=stops, shared=shared, limit_s=limit_s, large=large
            )
        except (OSError, TradeError) as bad:
            _logger.debug("calls to %s take the transport: %s", self._address.who, bad)
            self._not_before_s = time.monotonic() + _AGAIN_S
            return None
        slot = LocalSlot(name, connection, stops=stops, offered=large)
        self._path.slots.add(slot)
        if self._closed or self._path.closed:  # meanwhile
            self._end(slot)
            return None
        return slot

    def _find(self) -> Path | None:
        """Its socket, which exists before the container appears, or never."""
        if self._place is None:
            self._place = self._path.place_of(self._address)
            if self._place is None:
                self._not_before_s = float("inf")
        return self._place

    def take_back(self, slot: LocalSlot) -> None:
        """Takes back a connection, which the next call uses if it is whole."""
        free = self._free_for_stops if slot.stops else self._free
        if not (slot.whole or slot.answered):
            self._not_before_s = time.monotonic() + _AGAIN_S
        if slot.connection.large and not (slot.offered or slot.stops):
            self._large, slot.whole = True, False  # the next one has a shared segment
        if not slot.whole or self._closed or len(free) >= _MOST_FREE:
            self._end(slot)
        else:
            free.append(slot)
            if self._closed:  # meanwhile
                self.close()

    def _end(self, slot: LocalSlot) -> None:
        self._path.slots.discard(slot)
        slot.connection.close()

    def close(self) -> None:
        """Closes the free connections; the others end with their calls. Idempotent."""
        self._closed = True
        for starter in list(self._starters.values()):
            starter.break_off()
        for free in (self._free, self._free_for_stops):
            while free:
                try:
                    slot = free.pop()
                except IndexError:  # another thread took it
                    break
                self._end(slot)
