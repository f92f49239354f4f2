"""Worker threads for one channel (leader/followers): one thread always waits for the next message.

Quick calls need only two threads, however many calls arrive: more threads would wait for each other and for the
interpreter lock. So, beyond two, a call that finds no idle thread waits a moment for one to return before the pool
starts another. If none has returned for a moment though some work, these are not quick, and it does not wait. A thread
that returns to enough idle ones ends.
"""

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

from trade.transport.base import Channel, ChannelClosed, Message

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 64
_FEW: Final = 2
_MOMENT_S: Final = 0.005
"""A call that takes longer is not quick."""


class WorkerPool:
    """The worker threads of one channel; at least one of them always waits for the next message.

    A container's workers run calls with `Dispatcher.serve`; at the cap they refuse calls with `Dispatcher.busy`.
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
        """Threads that wait for another one to return."""
        self._since_s = 0.0
        """When one last returned, or began to work while no other did, by ``time.monotonic()``."""
        self._threads: list[threading.Thread] = []
        self._spawned = 0
        self._idle = 0
        self.taken = 0
        """The number of messages that it has begun to process, without refused ones."""
        self._closed = False
        with self._lock:
            self._spawn()

    @property
    def draining(self) -> bool:
        return self._idle > 0

    @property
    def working(self) -> int:
        """The number of threads that process a message now."""
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
        """Whether this thread may run the call: another one must remain to take the next call."""
        with self._lock:
            if self._idle == len(self._threads):
                self._since_s = time.monotonic()
            if self._idle == 1 and not self._get_another():
                return False
            self._idle -= 1
            self.taken += 1
            return True

    def _get_another(self) -> bool:
        """Whether another thread returns in a moment, or can be started. Requires the lock."""
        patience_s = self._since_s + _MOMENT_S - time.monotonic()
        if patience_s > 0 and _FEW <= len(self._threads) < MOST_THREADS:
            self._expecting += 1
            self._back.wait_for(lambda: self._idle > 1 or self._closed, patience_s)
            self._expecting -= 1
        if self._idle == 1 and len(self._threads) < MOST_THREADS and not self._closed:
            try:
                self._spawn()
            except RuntimeError:  # the process may have no more threads
                _logger.exception("%s cannot have another thread", self._name)
        return self._idle > 1

    def _join_idle(self) -> bool:
        """Whether this thread, whose call has ended, takes more calls."""
        with self._lock:
            self._since_s = time.monotonic()
            if self._idle >= _FEW:
                self._threads.remove(threading.current_thread())
                return False
            self._idle += 1
            if self._expecting:
                self._back.notify()
            return True

    def close(self) -> None:
        """Takes no more calls. No thread returns to the transport, where the end of the process would abort it."""
        with self._lock:
            self._closed = True
            self._back.notify_all()
        self._channel.close()

    def wait(self, most_s: float) -> None:
        """Waits until every thread has ended, at most ``most_s`` seconds."""
        deadline = time.monotonic() + most_s
        for thread in list(self._threads):
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
