"""Worker threads for a connection on which many calls are under way: its reader runs the quick ones itself.

To let another thread read takes longer than a quick call, because the two then take turns for the interpreter. So
while calls come one after the other, the reader runs each and reads the next, and one idle thread watches it. When a
call takes longer than a moment, the watcher becomes the reader. A call that is not known to be quick passes the reading
on before it runs, as every call does on other channels.
"""

import threading
from collections.abc import Callable
from functools import partial
from typing import Final, Protocol

from trade._threads.channel_workers import WorkerPool
from trade.transport.base import Channel, ChannelClosed, Message

_LOOK_S: Final = 0.0005
"""How often the watcher looks. It takes over from a call that it sees twice."""


class Work(Protocol):
    """Runs the call of a message."""

    def __call__(self, message: Message, *, pass_on: Callable[[], None] | None = None) -> None:
        """``pass_on`` lets another thread read the next message; None: another one does already."""


class QuickWorkerPool(WorkerPool):
    """The worker threads of such a connection. The reader counts as idle, until it passes the reading on.

    Of its idle threads one is the reader, at most one watches, and the others wait to become the reader.
    """

    def __init__(self, name: str, channel: Channel, work: Work, refuse: Callable[[Message], None]) -> None:
        self._run = work
        self._reading = threading.Lock()
        """Held for the reader, and released by the thread that passes the reading on."""
        self._watched = False
        self._own_call = 0
        """The number of the call that the reader runs itself; 0: none."""
        super().__init__(name, channel, work, refuse)

    @property
    def working(self) -> int:
        return super().working + bool(self._own_call)

    def _main(self) -> None:
        reads, watches = False, False
        while True:
            if not reads:
                self._become_reader(watch=watches)
            try:
                message = self._channel.receive()
            except ChannelClosed:
                self._reading.release()
                return
            number = self._keep_reading()
            leaves = not number and self._leave_idle()
            taken = self.taken
            if leaves:
                self._reading.release()
            if number:
                self._process(message, partial(self._run, pass_on=partial(self._pass_on, number)))
            else:
                self._process(message, self._run if leaves else self._refuse)
            reads = self._still_reads(number) if number else not leaves
            watches = self.taken != taken  # calls come one after the other
            if not reads and not self._join_idle():
                return

    def _become_reader(self, *, watch: bool) -> None:
        """Waits until no other thread is the reader; the one that watches also takes over."""
        with self._lock:
            watch = watch and not self._watched
            self._watched = self._watched or watch
        if watch and self._takes_over():
            return
        self._reading.acquire()

    def _takes_over(self) -> bool:
        """Watches the reader; returns whether this thread has become it. Otherwise there is nothing to watch."""
        seen = -1
        while not self._reading.acquire(timeout=_LOOK_S):
            with self._lock:
                if self.taken == seen:
                    self._watched = False
                    if not self._own_call:
                        return False
                    self._own_call = 0
                    self._idle -= 1  # the one that was the reader
                    return True
                seen = self.taken
        with self._lock:
            self._watched = False
        return True

    def _keep_reading(self) -> int:
        """The number of the call if this thread, the reader, may run it and read the next; otherwise 0."""
        with self._lock:
            if not self._watched:
                return 0
            self.taken += 1
            self._own_call = self.taken
            return self.taken

    def _pass_on(self, number: int) -> None:
        """Lets another thread read during this call, unless one does."""
        with self._lock:
            if self._own_call != number:
                return
            self._own_call = 0
            self._idle -= 1
        self._reading.release()

    def _still_reads(self, number: int) -> bool:
        """Whether this thread is still the reader at the end of its call."""
        with self._lock:
            if self._own_call != number:
                return False
            self._own_call = 0
            return True
