"""The thread of a bus: it waits for wires and for a bell, and does what other threads ask of it."""

import os
import select
import socket
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from trade_hil_sim.faults._commands import SimulationError

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["BusThread", "Mailbox", "listener", "ready"]

_T = TypeVar("_T")
_FEW: Final = 1024
"""``select`` knows lower numbers only, and waits as briefly as it is told; ``poll`` rounds up to a millisecond."""


class _HasFile(Protocol):
    def fileno(self) -> int: ...


File = TypeVar("File", bound="int | _HasFile")


def ready(reading: Sequence[File], writing: Sequence[File] = (), timeout_s: float | None = None) -> list[File]:
    """Those of the first that can be read, or have ended, once there is one or one of the second can be written.

    Args:
        reading: files, or things that have one.
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
    """A socket that listens on a port, or with 0 on any; raises OSError if it is taken."""
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
    """Calls to be made in one thread, in the order they came; nobody is left waiting when that ends.

    Args:
        who: whose thread it is, for messages.
        answer_s: how long one may take.
    """

    def __init__(self, who: str, answer_s: float) -> None:
        self._who, self._answer_s = who, answer_s
        self._asked: deque[tuple[Callable[[], None], Callable[[Exception], None]]] = deque()
        """How to carry out each call, and how to refuse it."""
        self._guard = threading.Lock()
        self._rope = -1
        """Where the bell is rung; below 0 while nobody listens."""
        self.bell = -1
        """Readable when something was asked for, or `ring` was called."""

    def open(self) -> None:
        """From here on the bell can be heard."""
        self.bell, self._rope = os.pipe()
        os.set_blocking(self.bell, False)
        os.set_blocking(self._rope, False)

    def ask(self, act: Callable[[], _T]) -> _T:
        """Have the thread make a call, and wait for what comes of it; not to be called in the thread itself.

        Raises:
            SimulationError: it does not listen any more.
            TimeoutError: it is busy with something else.
        """
        done: Future[_T] = Future()

        def carry_out() -> None:
            try:
                done.set_result(act())
            except Exception as problem:  # noqa: BLE001  # handed to the thread that asked
                done.set_exception(problem)

        with self._guard:
            if self._rope < 0:
                raise self._closed()
            self._asked.append((carry_out, done.set_exception))
            self._ring()
        return done.result(self._answer_s)

    def ring(self) -> None:
        """Wake the thread, for it to look for itself."""
        with self._guard:
            self._ring()

    def run(self) -> None:
        """In the thread, when the bell is heard: do what was asked."""
        with suppress(BlockingIOError):
            os.read(self.bell, 4096)
        while self._asked:
            self._asked.popleft()[0]()

    def close(self) -> None:
        """In the thread, at its end: who has asked and who does so from now on is told."""
        with self._guard:
            os.close(self._rope)
            self._rope = -1
        os.close(self.bell)
        while self._asked:
            self._asked.popleft()[1](self._closed())

    def _closed(self) -> SimulationError:
        return SimulationError(f"{self._who} is closed")

    def _ring(self) -> None:
        if self._rope >= 0:
            with suppress(BlockingIOError):  # it is rung already
                os.write(self._rope, b"!")


class BusThread(ABC):
    """A bus with a thread of its own, from `open` to `close`.

    Args:
        name: of the bus, in messages and of the thread.
        answer_s: how long the thread may take over what it is asked.
        kind: what it is, in messages.
    """

    def __init__(self, name: str, answer_s: float, kind: str = "bus") -> None:
        self.name = name
        self._who, self._answer_s = f"{kind} {name}", answer_s
        self._errands = Mailbox(self._who, answer_s)
        self._closing = False
        self._thread: threading.Thread | None = None

    def open(self) -> "Self":
        """Plug in: from now on clients can come."""
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
        """Hang up and end the thread. Idempotent; a log passed in stays open."""
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
        """Take what clients open; the bell can be heard already."""

    @abstractmethod
    def _step(self) -> None:
        """In the thread: wait for the bell and all else, and do what is due."""

    @abstractmethod
    def _end(self) -> None:
        """In the thread, at its end: free what clients open."""

    def _in_thread(self, act: Callable[[], _T]) -> _T:
        """Have the thread make a call; before `open`, make it here."""
        return act() if self._thread is None else self._ask(act)

    def _ask(self, act: Callable[[], _T]) -> _T:
        """Have the thread make a call; raises `SimulationError` while there is none."""
        return act() if threading.current_thread() is self._thread else self._errands.ask(act)

    def _run(self) -> None:
        try:
            while not self._closing:
                self._step()
        finally:
            self._closing = True
            self._end()
            self._errands.close()
