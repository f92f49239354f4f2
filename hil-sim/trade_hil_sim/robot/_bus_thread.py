"""The thread of a bus: it waits for I/O and a wake-up pipe, and carries out calls from other threads."""

import os
import select
import socket
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from trade_hil_sim.faults._commands import SimulationError

if TYPE_CHECKING:
    from typing_extensions import Self

_T = TypeVar("_T")
_FEW: Final = 1024
"""``select`` supports only lower descriptors, but any timeout; ``poll`` rounds up to a millisecond."""


class _HasFile(Protocol):
    def fileno(self) -> int: ...


File = TypeVar("File", bound="int | _HasFile")


def ready(reading: Sequence[File], writing: Sequence[File] = (), timeout_s: float | None = None) -> list[File]:
    """Waits until a file of the first is readable or ended, or one of the second writable; returns those of the first.

    Args:
        reading: files, or objects with a descriptor.
        writing: likewise.
        timeout_s: how long to wait, in seconds; None: as long as it takes.
    """
    numbers = {_number(thing): thing for thing in reading}
    wanted = dict.fromkeys(numbers, select.POLLIN)
    for thing in writing:
        number = _number(thing)
        wanted[number] = wanted.get(number, 0) | select.POLLOUT
    if timeout_s is not None and all(number < _FEW for number in wanted):
        to_write = [number for number, events in wanted.items() if events & select.POLLOUT]
        got = set(select.select(list(numbers), to_write, (), max(0.0, timeout_s))[0])
        return [thing for number, thing in numbers.items() if number in got]
    poll = select.poll()
    for number, events in wanted.items():
        poll.register(number, events)
    found = dict(poll.poll(None if timeout_s is None else max(0.0, timeout_s) * 1000))
    return [thing for number, thing in numbers.items() if found.get(number, 0) & ~select.POLLOUT]


def _number(thing: "int | _HasFile") -> int:
    return thing if isinstance(thing, int) else thing.fileno()


def listener(host: str, number: int) -> socket.socket:
    """A socket that listens on a port, or with 0 on any; raises OSError if the port is in use."""
    made = socket.socket()
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((host, number))
        made.listen()
        made.setblocking(False)
    except OSError:
        made.close()
        raise
    return made


class Mailbox:
    """A queue of calls that one thread makes in order; calls that are left when it ends are refused.

    Args:
        who: the thread's owner, for messages.
        answer_s: how long a call may take.
    """

    def __init__(self, owner: str, answer_s: float) -> None:
        self._who, self._answer_s = owner, answer_s
        self._jobs: deque[tuple[Callable[[], None], Callable[[Exception], None]]] = deque()
        """For each call, the functions that carry it out and refuse it."""
        self._guard = threading.Lock()
        self._wake_write = -1
        """The write end of the wake-up pipe; below 0 while the thread does not listen."""
        self.wake_read = -1
        """Readable after a call was queued or `ring` was called."""

    def open(self) -> None:
        """Open the wake-up pipe."""
        self.wake_read, self._wake_write = os.pipe()
        os.set_blocking(self.wake_read, False)
        os.set_blocking(self._wake_write, False)

    def ask(self, act: Callable[[], _T]) -> _T:
        """Let the thread make a call, and wait for its result; not to be called in the thread itself.

        Raises:
            SimulationError: the thread is busy, or no longer listens.
        """
        done: Future[_T] = Future()

        def carry_out() -> None:
            try:
                done.set_result(act())
            except Exception as problem:  # noqa: BLE001  # handed to the thread that asked
                done.set_exception(problem)

        with self._guard:
            if self._wake_write < 0:
                raise self._closed()
            self._jobs.append((carry_out, done.set_exception))
            self._ring()
        try:
            return done.result(self._answer_s)
        except FutureTimeout:
            raise SimulationError(f"{self._who} is busy") from None

    def ring(self) -> None:
        """Wake the thread."""
        with self._guard:
            self._ring()

    def run(self) -> None:
        """In the thread, after a wake-up: make the queued calls."""
        with suppress(BlockingIOError):
            os.read(self.wake_read, 4096)
        while self._jobs:
            self._jobs.popleft()[0]()

    def close(self) -> None:
        """In the thread, at its end: refuse queued and later calls."""
        with self._guard:
            os.close(self._wake_write)
            self._wake_write = -1
        os.close(self.wake_read)
        while self._jobs:
            self._jobs.popleft()[1](self._closed())

    def _closed(self) -> SimulationError:
        return SimulationError(f"{self._who} is closed")

    def _ring(self) -> None:
        if self._wake_write >= 0:
            with suppress(BlockingIOError):  # a wake-up is pending already
                os.write(self._wake_write, b"!")


class BusThread(ABC):
    """A bus with its own thread, from `open` to `close`.

    Args:
        name: of the bus, in messages and of the thread.
        answer_s: how long the thread may take for a call.
        kind: the kind of bus, in messages.
    """

    def __init__(self, name: str, answer_s: float, kind: str = "bus") -> None:
        self.name = name
        self._who, self._answer_s = f"{kind} {name}", answer_s
        self._errands = Mailbox(self._who, answer_s)
        self._closing = False
        self._thread: threading.Thread | None = None

    def open(self) -> "Self":
        """Plug in: from now on clients can connect."""
        if self._thread is not None:
            raise SimulationError(f"{self._who} is open, or was; make a new one")
        self._errands.open()
        try:
            self._begin()
        except BaseException:
            self._errands.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"sim-{self.name}", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        """Disconnect clients and end the thread. Idempotent; a log passed in stays open."""
        if self._thread is None or self._closing:
            return
        self._closing = True
        self._errands.ring()
        if threading.current_thread() is not self._thread:
            self._thread.join(self._answer_s)

    def __enter__(self) -> "Self":
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    @abstractmethod
    def _begin(self) -> None:
        """Open the ports for clients; the wake-up pipe is open already."""

    @abstractmethod
    def _step(self) -> None:
        """In the thread: wait for wake-ups and I/O, and do what is due."""

    @abstractmethod
    def _end(self) -> None:
        """In the thread, at its end: free the ports."""

    def _in_thread(self, act: Callable[[], _T]) -> _T:
        """Let the thread make a call; before `open`, make it here."""
        return act() if self._thread is None else self._ask(act)

    def _ask(self, act: Callable[[], _T]) -> _T:
        """Let the thread make a call; raises `SimulationError` while it does not run."""
        return act() if threading.current_thread() is self._thread else self._errands.ask(act)

    def _run(self) -> None:
        try:
            while not self._closing:
                self._step()
        finally:
            self._closing = True
            self._end()
            self._errands.close()
