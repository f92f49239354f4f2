"""Worker threads for one channel (leader/followers): one thread always waits for the next message.

Quick calls need only a few threads, however many calls arrive: more threads would wait for each other and for the
interpreter lock. Slow calls need a thread each, and none of them should wait for another: they may start the joints of
an arm. Calls count as quick while a thread has returned within a moment. A call that finds no idle thread starts one:
up to four threads while calls are quick, and up to eight else. Beyond these it waits a moment for one to return. If
none returns, the calls that run are slow, and the next ones do not wait. A thread that returns to enough idle ones
ends.
"""

import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Final

from trade.transport.base import Channel, ChannelClosed, Message

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 64
_FEW: Final = 4
"""Threads for quick calls."""
_SEVERAL: Final = 8
"""Threads for calls of which none has returned, without waiting for one."""
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
        self._returned_s = self._busy_s = -math.inf
        """When one last returned, and when one last began to work while no other did, by ``time.monotonic()``."""
        self._threads: list[threading.Thread] = []
        self._spawned = 0
        self._idle = 0
        self.taken: int = 0
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
            self._process(message, self._work if left else self._refuse)
            if left and not self._join_idle():
                return

    def _process(self, message: Message, work: Callable[[Message], None]) -> None:
        try:
            work(message)
        except ChannelClosed:
            _logger.debug("no answer on %s: the container is closing", message.key)
        except Exception:
            _logger.exception("a call on %s could not be answered", message.key)

    def _leave_idle(self) -> bool:
        """Whether this thread may run the call: another one must remain to take the next call."""
        with self._lock:
            if self._idle == len(self._threads):
                self._busy_s = time.monotonic()
            if self._idle == 1 and not self._get_another():
                return False
            self._idle -= 1
            self.taken += 1
            return True

    def _get_another(self) -> bool:
        """Whether another thread returns in a moment, or can be started. Requires the lock."""
        now_s = time.monotonic()
        enough = _FEW if now_s < self._returned_s + _MOMENT_S else _SEVERAL
        patience_s = max(self._returned_s, self._busy_s) + _MOMENT_S - now_s
        if patience_s > 0 and enough <= len(self._threads) < MOST_THREADS:
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
            self._returned_s = time.monotonic()
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
