"""Clients: each has its own session, and its locks, calls and streams end with it (S03, S05)."""

import secrets
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

from msgspec import Struct

from trade import Container, Handle, Lock, Run, Session
from trade_gateway.clients._errors import NoSuchSession, TooMany

MOST_CALLS: Final = 64
MOST_CALLS_OF_ONE: Final = 16
MOST_CLIENTS: Final = 64
MOST_OF_ONE: Final = 16
"""Most lasting sessions of one identity; those of single requests do not count."""
MOST_LOCKS: Final = 16
"""Most locks of one session."""

Place = tuple[object, str]
"""A resource, and the container that manages it."""


class ClientLock(Struct, frozen=True):
    """A lock of a client."""

    lock: Lock
    covers: frozenset[Place]
    """The services that it covers."""


class Client:
    """One page, program or request. Its methods may block: they are for threads, not for the event loop."""

    def __init__(self, identity: str, session: Session, left: "Callable[[Client], None]") -> None:
        self.identity: Final = identity
        self.session: Final = session
        self.secret: Final = secrets.token_urlsafe(18)
        """The secret that proves a request to be its own."""
        self._left = left
        self._locks: dict[str, ClientLock] = {}
        self._runs: set[Run] = set()
        self._guard = threading.Lock()
        self._leaving = False
        self._stops = 0
        self._stopping: dict[object, tuple[int, Callable[[], object]]] = {}
        """The last call of each stop service."""
        self._callbacks: list[Callable[[], object]] = []

    @property
    def closed(self) -> bool:
        return self.session.closed

    @property
    def busy(self) -> bool:
        """Whether it has a lock, or a call in progress."""
        return bool(self._locks or self._runs)

    @contextmanager
    def speaking(self) -> Generator[None]:
        """Makes calls inside the context as the client, under its locks, also lost ones until they are released.

        Raises SessionEnded.
        """
        self.session.check()
        with ExitStack() as around:
            around.enter_context(self.session.use())
            for held in list(self._locks.values()):
                around.enter_context(held.lock.use())
            yield

    # --- calls

    def admit(self, handle: Handle) -> int:
        """Counts a request for a call; returns the number of stops so far, including this one."""
        stops = handle.effect == "stop"
        with self._guard:
            self._stops += stops
            return self._stops

    @property
    def stops(self) -> int:
        """The number of stops requested so far."""
        return self._stops

    def overtaken(self, admitted: int) -> bool:
        """Whether a stop was requested after that number; calls that had not begun by then must not begin (S08)."""
        return self._stops != admitted

    def stopping(self, admitted: int, handle: Handle, again: Callable[[], object]) -> None:
        """Registers a stop that is about to be sent, and how to repeat it."""
        self._stopping[handle.key] = admitted, again

    def stop_again(self, admitted: int) -> None:
        """Repeats the last stop after a call of that number, which may have been sent after a later stop."""
        for number, again in list(self._stopping.values()):
            if number > admitted:
                again()

    def note(self, run: Run) -> None:
        """Ties a call to the client's end."""
        self._runs.add(run)
        run.add_done_callback(self._runs.discard)
        if self.closed:  # closed meanwhile
            run.ask_to_end()

    def cancel(self, run: Run) -> None:
        """Cancels a call of this client."""
        with self.speaking():
            run.cancel()

    # --- locks

    def locking(self) -> None:
        """Raises TooMany: it has the most locks allowed."""
        if len(self._locks) >= MOST_LOCKS:
            raise TooMany(what="locks of this session", limit=MOST_LOCKS)

    def keep(self, lock: Lock, handles: list[Handle]) -> str:
        """Stores a taken lock; returns its name."""
        name = secrets.token_hex(4)
        self._locks[name] = ClientLock(lock, frozenset(places(handles)))
        if self.closed:  # closed meanwhile
            self.unlock(name)
        return name

    def unlock(self, name: str) -> bool:
        """Releases a lock; returns whether it existed."""
        held = self._locks.pop(name, None)
        if held is not None:
            held.lock.release()
        return held is not None

    def name_of(self, lock: Lock) -> str:
        """The name of a lock; empty if the client does not have it, or not yet."""
        return next((name for name, held in self._locks.copy().items() if held.lock is lock), "")

    def has_locked(self, handle: Handle) -> bool:
        """Whether it holds all resources of a service."""
        held = {place for one in list(self._locks.values()) if one.lock.held for place in one.covers}
        return held.issuperset(places([handle]))

    # --- its end

    def when_closed(self, callback: Callable[[], object]) -> None:
        """Registers a callback for its end, on any thread; it runs at once if the client is closed."""
        self._callbacks.append(callback)
        if self.closed:
            callback()

    def close(self) -> None:
        """Stops its motion, releases its locks and cancels its calls. Idempotent."""
        with self._guard:
            if self._leaving:
                return
            self._leaving = True
        self.session.close()
        self._left(self)
        for run in list(self._runs):
            run.ask_to_end()
        for tell in list(self._callbacks):
            tell()


class Clients:
    """The registry of clients."""

    def __init__(self, container: Container) -> None:
        self._container = container
        self._all: dict[str, Client] = {}
        self._lasting: dict[object, str] = {}
        """Identities of the sessions that count."""
        self._guard = threading.Lock()

    def open(self, identity: str) -> Client:
        """Opens a lasting session. May block. Raises TooMany."""
        with self._guard:
            if len(self._lasting) >= MOST_CLIENTS:
                raise TooMany(what="sessions", limit=MOST_CLIENTS)
            if list(self._lasting.values()).count(identity) >= MOST_OF_ONE:
                raise TooMany(what=f"sessions of {identity}", limit=MOST_OF_ONE)
            place = object()
            self._lasting[place] = identity
        try:
            client = self.open_for_one(identity)
        except BaseException:
            self._lasting.pop(place, None)
            raise
        client.when_closed(lambda: self._lasting.pop(place, None))
        return client

    def open_for_one(self, identity: str) -> Client:
        """Opens a session for one request. Their number is not limited, so that every stop has one (S07)."""
        client = Client(identity, self._container.open_session(identity), self._left)
        self._all[client.secret] = client
        return client

    def of(self, secret: str, identity: str) -> Client:
        """The client that made a request. Raises NoSuchSession."""
        client = self._all.get(secret)
        if client is None or client.identity != identity or client.closed:
            raise NoSuchSession(session=secret[:8])
        return client

    def _left(self, client: Client) -> None:
        self._all.pop(client.secret, None)

    def __iter__(self) -> Iterator[Client]:
        return iter(list(self._all.values()))

    def close(self) -> None:
        """Closes all clients. Idempotent."""
        for client in self:
            client.close()


class Quota:
    """A limit of pending calls and lock requests; stops do not count (S07)."""

    def __init__(self) -> None:
        self._under_way: Counter[str] = Counter()
        self._guard = threading.Lock()

    def take(self, identity: str) -> Callable[[], None]:
        """Counts one; returns a function to call once at its end, on any thread. Raises TooMany."""
        with self._guard:
            if sum(self._under_way.values()) >= MOST_CALLS:
                raise TooMany(what="pending calls", limit=MOST_CALLS)
            if self._under_way[identity] >= MOST_CALLS_OF_ONE:
                raise TooMany(what=f"pending calls of {identity}", limit=MOST_CALLS_OF_ONE)
            self._under_way[identity] += 1
        return lambda: self._ended(identity)

    def _ended(self, identity: str) -> None:
        with self._guard:
            self._under_way[identity] -= 1
            if not self._under_way[identity]:
                del self._under_way[identity]


def places(handles: Iterable[Handle]) -> set[Place]:
    """The resources of services, and their containers; a service without resources counts as one."""
    return {(handle.key.address, name) for handle in handles for name in handle.resources or (_itself(handle),)}


def _itself(handle: Handle) -> str:
    return f"{handle.key.domain}/{handle.key.provider}/{handle.name}"
