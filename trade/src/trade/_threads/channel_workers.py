"""Threads that take turns at one channel: the one that takes a call is replaced before it runs it.

Quick calls need few of them, however many calls there are: more would only wait for each other, and for the interpreter
with all others of the process. So beyond a few a call that finds none but its own thread waits a moment for one to come
back before another is started, and who comes back to enough others ends.
"""

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

from trade._transport.base import Channel, ChannelClosed, Message

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 64
_FEW: Final = 4
_MOMENT_S: Final = 0.005
"""A call that takes longer is not quick."""


class WorkerPool:
    """Threads on one channel; at least one of them always waits for the next message.

    Those of a container work at calls with `Dispatcher._serve`, and refuse them at the cap with `Dispatcher._busy`.
    """

    def __init__(
        self, name: str, channel: Channel, work: Callable[[Message], None], refuse: Callable[[Message], None]
    ) -> None:
        self._name = name
        self._channel = channel
        self._work = work
        self._refuse = refuse
        self._lock = threading.Lock()
        self._back = threading.Condition(self._lock)
        self._expecting = 0
        """Threads that wait for another one to come back."""
        self._threads: list[threading.Thread] = []
        self._spawned = 0
        self._idle = 0
        self.taken = 0
        """Messages it has begun to work at, refused ones left out."""
        self._closed = False
        with self._lock:
            self._spawn()

    @property
    def draining(self) -> bool:
        return self._idle > 0

    @property
    def working(self) -> int:
        """Threads that work at a message now."""
        with self._lock:
            return len(self._threads) - self._idle

    def _spawn(self) -> None:
        thread = threading.Thread(target=self._main, name=f"{self._name}-{self._spawned}", daemon=True)
        thread.start()
        self._threads.append(thread)
        self._spawned += 1
        self._idle += 1

    def _main(self) -> None:
        while not self._closed:
            try:
                message = self._channel.receive()
            except ChannelClosed:
                return
            left = self._leave_idle()
            try:
                (self._work if left else self._refuse)(message)
            except ChannelClosed:
                _logger.debug("no answer on %s: the container is closing", message.key)
            except Exception:
                _logger.exception("a call on %s could not be answered", message.key)
            if left and not self._join_idle():
                return

    def _leave_idle(self) -> bool:
        """Whether this thread may run the call: somebody else must be left to take the next one."""
        with self._lock:
            if self._idle == 1 and not self._get_another():
                return False
            self._idle -= 1
            self.taken += 1
            return True

    def _get_another(self) -> bool:
        """Whether somebody comes back in a moment, or can be spawned; with the lock held."""
        if _FEW <= len(self._threads) < MOST_THREADS:
            self._expecting += 1
            self._back.wait_for(lambda: self._idle > 1 or self._closed, _MOMENT_S)
            self._expecting -= 1
        if self._idle == 1 and len(self._threads) < MOST_THREADS and not self._closed:
            try:
                self._spawn()
            except RuntimeError:  # the process may have no more threads
                _logger.exception("%s cannot have another thread", self._name)
        return self._idle > 1

    def _join_idle(self) -> bool:
        """Whether this thread, whose call has ended, is to take more."""
        with self._lock:
            if self._idle >= _FEW:
                self._threads.remove(threading.current_thread())
                return False
            self._idle += 1
            if self._expecting:
                self._back.notify()
            return True

    def close(self) -> None:
        """Take no more calls. No thread goes back into the transport, where the end of the process would abort it."""
        with self._lock:
            self._closed = True
            self._back.notify_all()
        self._channel.close()

    def wait(self, most_s: float) -> None:
        """Wait until every thread has ended, or for so long."""
        deadline = time.monotonic() + most_s
        for thread in list(self._threads):
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
