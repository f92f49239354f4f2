"""The callee's end of the local path.

A connection for one call at a time has a thread, which reads a call, runs it, and answers. A shared one has several, as
a channel of the transport has.
"""

import errno
import logging
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from msgspec import Raw

from trade._services.dispatcher import Dispatcher
from trade._services.process_watch import ProcessWatch
from trade._threads.channel_workers import MOST_THREADS, WorkerPool
from trade._threads.quick_workers import QuickWorkerPool
from trade.errors import TradeError
from trade.protocol.keys import Address
from trade.protocol.messages import Malformed
from trade.transport.base import Channel, ChannelClosed, Message, Publisher
from trade.transport.local_connection import ConnectionEnded, LocalConnection
from trade.transport.local_greeting import Greeting, Passport

_logger = logging.getLogger("trade")

_MOST_FOR_CALLS: Final = 256
"""Connections of one identity for calls."""
_MOST_FOR_STOPS: Final = 64
"""Its connections for stops."""
_MOST: Final = 1024
"""Connections of all."""
_MOST_KEYS: Final = 1024
_LOOK_S: Final = 0.2
_NO_DESCRIPTORS_S: Final = 0.1
"""How long it waits after it could not accept a connection."""


class LocalReplier(Publisher):
    """Answers on a connection. What it can no longer send is not missed: the caller asks again on the transport."""

    def __init__(self, connection: LocalConnection) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._ended = False

    def put(self, payload: bytes) -> None:
        self._send(payload)

    def put_parts(self, head: bytes, body: Raw | bytes) -> None:
        self._send(head, body)

    def _send(self, *parts: bytes | Raw) -> None:
        with self._sending:
            if self._ended:
                return
            try:
                self._connection.send(*parts)
            except ConnectionEnded:
                self._connection.break_off()  # half an answer may be on it

    def close(self) -> None:
        self._connection.break_off()

    def end(self) -> None:
        """Sends nothing more, from any thread, so that the connection can be closed."""
        with self._sending:
            self._ended = True


class LocalChannel(Channel):
    """The calls that come in on a shared connection."""

    def __init__(self, connection: LocalConnection, checked: "Keys") -> None:
        self._connection = connection
        self._keys = checked
        self._receiving = threading.Lock()
        self.ended = threading.Event()
        """Set when no thread receives any more."""
        self.problem: Malformed | None = None
        """Why it ended, if what arrived was no call."""

    def receive(self) -> Message:
        with self._receiving:
            if self.ended.is_set():
                raise ChannelClosed
            try:
                raw, payload = self._connection.receive()
                return Message(self._keys.text(raw), payload)
            except ConnectionEnded:
                self.ended.set()
            except Malformed as bad:
                self.problem = bad
                self.ended.set()
        raise ChannelClosed

    def close(self) -> None:
        self._connection.hang_up()
        with self._receiving:  # a thread that receives returns now
            self.ended.set()


class Keys:
    """The keys of the calls, or of the stops, that one identity may make on a connection."""

    def __init__(self, identity: str, *, stops: bool) -> None:
        self._begins = f"{'stop' if stops else 'call'}/{identity}/"
        self._known: dict[bytes, str] = {}

    def text(self, raw: bytes) -> str:
        """The key as a text. Raises Malformed if it is not one of the identity that the connection has."""
        known = self._known.get(raw)
        if known is not None:
            return known
        key = raw.decode("utf-8", "replace")
        if not key.startswith(self._begins):
            raise Malformed(f"{key!r} is no key of its caller")
        if len(self._known) < _MOST_KEYS:
            self._known[raw] = key
        return key


class LocalServer:
    """Takes the connections of this host's containers. The dispatcher closes it, as it does its other pools.

    Args:
        server: the listening socket.
        place: its file.
        passport: what the container proves its identity with.
        dispatcher: runs the calls.
        ended: called with each caller whose process has ended.
    """

    def __init__(
        self,
        server: socket.socket,
        place: Path,
        passport: Passport,
        dispatcher: Dispatcher,
        ended: Callable[[Address], None],
    ) -> None:
        self._server = server
        self._place = place
        self._passport = passport
        self._dispatcher = dispatcher
        self._lock = threading.Lock()
        self._threads: dict[threading.Thread, LocalConnection | None] = {}
        """A thread for each connection, None before it is greeted, and for each call that was handed over."""
        self._connections: Counter[tuple[str, bool]] = Counter()
        """How many each identity has: for stops, and for all other calls."""
        self._working: Counter[str] = Counter()
        """How many calls of each identity it processes now."""
        self._closed = False
        self.taken = 0
        """The number of calls that it has begun to process, without refused ones."""
        self._processes = ProcessWatch(ended)
        self._reserve: int | None = os.open(os.devnull, os.O_RDONLY)
        """A descriptor to give up when there is no other, so that a connection can be refused."""
        self._accepting = threading.Thread(target=self._accept, name="trade-local", daemon=True)
        self._accepting.start()

    @property
    def draining(self) -> bool:
        """Whether it takes calls."""
        return not self._closed

    @property
    def working(self) -> int:
        """The number of calls that it processes now."""
        return self._working.total()

    def _accept(self) -> None:
        while not self._closed:
            try:
                sock, _ = self._server.accept()
            except OSError as bad:
                if not self._closed:
                    self._refuse(bad)
                continue
            with self._lock:
                full = self._closed or len(self._threads) >= _MOST
            if full or not self._begin(self._main, sock):
                sock.close()
        self._server.close()
        if self._reserve is not None:
            os.close(self._reserve)

    def _refuse(self, problem: OSError) -> None:
        """Drops the next connection, which would wait for an answer, when there is no descriptor for it."""
        _logger.debug("no connection for local calls: %s", problem)
        if problem.errno in (errno.EMFILE, errno.ENFILE) and self._reserve is not None:
            os.close(self._reserve)
            self._reserve = None
            with suppress(OSError):
                self._server.accept()[0].close()
        else:
            time.sleep(_NO_DESCRIPTORS_S)
        if self._reserve is None:
            with suppress(OSError):
                self._reserve = os.open(os.devnull, os.O_RDONLY)

    def _begin(self, work: Callable[..., None], *args: object) -> bool:
        """Runs work on a thread that `wait` waits for; returns whether the process may have another one."""
        thread = threading.Thread(target=self._run, args=(work, *args), name="trade-local-call", daemon=True)
        with self._lock:
            self._threads[thread] = None
        try:
            thread.start()
        except RuntimeError:
            _logger.exception("a local call cannot have a thread")
            with self._lock:
                del self._threads[thread]
            return False
        return True

    def _run(self, work: Callable[..., None], *args: object) -> None:
        try:
            work(*args)
        finally:
            with self._lock:
                del self._threads[threading.current_thread()]

    def _hand_over(self, work: Callable[[], None]) -> None:
        if not self._begin(work):
            work()

    def _main(self, sock: socket.socket) -> None:
        try:
            connection, greeting = self._passport.welcome(sock)
        except (OSError, TradeError) as bad:
            _logger.debug("a local connection was not greeted: %s", bad)
            return
        except Malformed as bad:
            self._dispatcher.drop("a local connection", "?", bad)
            return
        owner = greeting.caller.identity, greeting.stops
        try:
            if self._admits(connection, greeting):
                self._processes.watch(connection.process, greeting.caller)
                self._serve(connection, greeting)
        except Malformed as bad:
            self._dispatcher.drop("a local connection", owner[0], bad)
        finally:
            with self._lock:
                self._connections[owner] -= 1
                self._connections += Counter()  # forget identities without connections
            connection.close()

    def _admits(self, connection: LocalConnection, greeting: Greeting) -> bool:
        """Whether this container takes calls on a connection; counts it."""
        known, owner = self._dispatcher.callers, (greeting.caller.identity, greeting.stops)
        with self._lock:
            self._threads[threading.current_thread()] = connection
            self._connections[owner] += 1
            full = self._connections[owner] > (_MOST_FOR_STOPS if greeting.stops else _MOST_FOR_CALLS)
            return not (full or self._closed) and (not known or greeting.caller.identity in known)

    def _serve(self, connection: LocalConnection, greeting: Greeting) -> None:
        """Processes the calls on a connection until it ends. Raises Malformed."""
        dispatcher, who, reply = self._dispatcher, greeting.caller.identity, greeting.reply
        keys, replier = Keys(who, stops=greeting.stops), LocalReplier(connection)
        dispatcher.answer_on(who, reply, replier)
        try:
            if greeting.shared:
                self._share(LocalChannel(connection, keys), stops=greeting.stops)
                return
            while not self._closed:
                raw, payload = connection.receive()
                self._process(who, Message(keys.text(raw), payload), stops=greeting.stops)
        except ConnectionEnded:
            return
        finally:
            dispatcher.answer_no_more(who, reply, replier)
            replier.end()

    def _share(self, channel: LocalChannel, *, stops: bool) -> None:
        """Processes the calls of a shared connection; no stop waits for another. Raises Malformed."""
        name, serve = "trade-local-call", self._dispatcher.serve
        if stops:
            pool = WorkerPool(name, channel, serve, refuse=serve)
        else:
            pool = QuickWorkerPool(name, channel, serve, self._dispatcher.busy)
        self._dispatcher.pools.append(pool)
        if self._closed:  # meanwhile
            pool.close()
        channel.ended.wait()
        pool.close()
        while pool.working and not self._closed:  # the dispatcher waits for its threads as long as it knows the pool
            pool.wait(_LOOK_S)
        with self._lock:
            if not self._closed:
                self._dispatcher.pools.remove(pool)
                self.taken += pool.taken
        if channel.problem is not None:
            raise channel.problem

    def _process(self, identity: str, message: Message, *, stops: bool) -> None:
        with self._lock:
            full = self._working[identity] >= MOST_THREADS and not stops
            self._working[identity] += 1
            self.taken += not full
        try:
            if full:
                self._dispatcher.busy(message)
            else:
                self._dispatcher.serve(message, self._hand_over)
        except ChannelClosed:
            _logger.debug("no answer on %s: the container is closing", message.key)
        except Exception:
            _logger.exception("a call on %s could not be answered", message.key)
        finally:
            with self._lock:
                self._working[identity] -= 1

    def close(self) -> None:
        """Takes no more calls; those under way still get their answers. Idempotent."""
        with self._lock:
            self._closed = True
            connections = list(self._threads.values())
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)  # wakes the thread that accepts
        self._place.unlink(missing_ok=True)
        for connection in connections:
            if connection is not None:
                connection.hang_up()

    def wait(self, most_s: float) -> None:
        """Waits until every thread has ended, at most ``most_s`` seconds."""
        until_s = time.monotonic() + most_s
        for thread in [self._accepting, *self._threads]:
            if thread is not threading.current_thread() and thread.is_alive():
                thread.join(max(0.0, until_s - time.monotonic()))
        self._processes.close()

    def abandon(self) -> None:
        """Lets go of all descriptors in a forked child, without a lock; they continue in the parent."""
        self._closed = True
        self._server.close()
        self._processes.abandon()
        for connection in self._threads.values():
            if connection is not None:
                connection.abandon()
