"""Threads that take turns at one channel: the one that takes a call is replaced before it runs it."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

from trade._transport import Channel, ChannelClosed, Message

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 64


class Crew:
    """Threads on one channel; at least one of them always waits for the next message."""

    def __init__(
        self, name: str, channel: Channel, work: Callable[[Message], None], refuse: Callable[[Message], None]
    ) -> None:
        self._name = name
        self._channel = channel
        self._work = work
        self._refuse = refuse
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        self._dismissed = False
        with self._lock:
            self._hire()

    @property
    def draining(self) -> bool:
        return self._idle > 0

    def _hire(self) -> None:
        thread = threading.Thread(target=self._main, name=f"{self._name}-{len(self._threads)}", daemon=True)
        thread.start()
        self._threads.append(thread)
        self._idle += 1

    def _main(self) -> None:
        while not self._dismissed:
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
            finally:
                if left:
                    with self._lock:
                        self._idle += 1

    def _leave_idle(self) -> bool:
        """Whether this thread may run the call: somebody else must be left to take the next one."""
        with self._lock:
            try:
                if self._idle == 1 and len(self._threads) < MOST_THREADS and not self._dismissed:
                    self._hire()
            except RuntimeError:  # the process may have no more threads
                _logger.exception("%s cannot have another thread", self._name)
            if self._idle == 1:
                return False
            self._idle -= 1
            return True

    def dismiss(self) -> None:
        """Take no more calls. No thread goes back into the transport, where the end of the process would abort it."""
        with self._lock:
            self._dismissed = True
        self._channel.close()

    def wait(self, most_s: float) -> None:
        """Wait until every thread has ended, or for so long."""
        deadline = time.monotonic() + most_s
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
