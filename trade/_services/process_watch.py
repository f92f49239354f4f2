"""Watches the processes of callers on this host, whose ends the kernel reports at once.

The end of a connection is no such sign: a living caller closes connections, too. Nor is the end of a link of the
transport, which a forked child of the caller keeps open until a lease has passed.
"""

import logging
import os
import select
import threading
from collections.abc import Callable
from typing import Final

from trade.protocol.keys import Address

_logger = logging.getLogger("trade")

_CAN_WATCH: Final = hasattr(os, "pidfd_open") and hasattr(select, "epoll")
"""On Linux. Elsewhere only the transport says that a container has ended."""


class ProcessWatch:
    """Reports each caller whose process has ended.

    Args:
        ended: called with the container of the process, on a thread of this object.
    """

    def __init__(self, ended: Callable[[Address], None]) -> None:
        self._ended = ended
        self._lock = threading.Lock()
        self._watched: dict[int, Address] = {}
        """The descriptor of a process for each of its containers: a process number may be used again."""
        self._poll: select.epoll | None = None
        self._wake: tuple[int, int] | None = None
        """A pipe that ends the thread."""
        self._thread: threading.Thread | None = None
        self._closed = False

    def watch(self, process: int, caller: Address) -> None:
        """Watches a process for a container in it, if the operating system can; 0 stands for an unknown process."""
        if not _CAN_WATCH or process in (0, os.getpid()):
            return
        gone = False
        with self._lock:
            if self._closed or caller in self._watched.values():
                return
            try:
                self._add(process, caller)
            except ProcessLookupError:
                gone = True
            except (OSError, RuntimeError) as bad:  # there are no more descriptors or threads
                _logger.debug("the process of %s is not watched: %s", caller.who, bad)
        if gone:
            self._report(caller)

    def _add(self, process: int, caller: Address) -> None:
        descriptor = os.pidfd_open(process)
        try:
            if self._poll is None:
                self._poll, self._wake = select.epoll(), os.pipe()
                self._poll.register(self._wake[0], select.EPOLLIN)
            if self._thread is None:
                thread = threading.Thread(target=self._run, args=(self._poll,), name="trade-processes", daemon=True)
                thread.start()
                self._thread = thread
            self._poll.register(descriptor, select.EPOLLIN)
        except BaseException:
            os.close(descriptor)
            raise
        self._watched[descriptor] = caller

    def _run(self, poll: select.epoll) -> None:
        while not self._closed:
            for descriptor, _ in poll.poll():
                with self._lock:
                    caller = self._watched.pop(descriptor, None)
                    if caller is not None:
                        poll.unregister(descriptor)
                        os.close(descriptor)
                if caller is not None:
                    self._report(caller)
        self.abandon()

    def _report(self, caller: Address) -> None:
        try:
            self._ended(caller)
        except Exception:
            _logger.exception("the end of %s could not be handled", caller.who)

    def close(self) -> None:
        """Ends the thread. Idempotent."""
        with self._lock:
            if not self._closed and self._wake is not None:
                os.write(self._wake[1], b"\0")
            self._closed = True
        if self._thread is None:
            self.abandon()
        elif self._thread is not threading.current_thread():
            self._thread.join(2)

    def abandon(self) -> None:
        """Lets go of all descriptors, without a lock: also in a forked child."""
        self._closed = True
        poll, wake, watched = self._poll, self._wake, list(self._watched)
        self._poll = self._wake = None
        self._watched.clear()
        for descriptor in (*watched, *(wake or ())):
            os.close(descriptor)
        if poll is not None:
            poll.close()
