"""A thread pool that reuses idle threads; it has no maximum, and its threads are daemons (decision 78).

Starting a thread takes longer than most calls. A hook is such a call: it runs on another thread, so that it can be cut
off. The `Scheduler` has its own, limited threads, because work in this pool may last for minutes, as a motion does, and
must not delay anything else.
"""

import logging
import threading
from collections.abc import Callable
from contextvars import Context
from typing import Final

_logger = logging.getLogger("trade")

_MOST_IDLE: Final = 8
_PATIENCE_S: Final = 10.0
"""How long an idle thread waits for work before it ends."""

Work = Callable[[], object]


class ThreadPool:
    """One thread for each piece of work under way; a few idle threads wait for more."""

    def __init__(self) -> None:
        self._idle: list[_Worker] = []
        self._closed = False

    def begin(self, work: Work, name: str) -> None:
        """Runs work now, on a thread that it does not share meanwhile; does not wait.

        Args:
            work: what to do, in a fresh context.
            name: the name of the thread meanwhile.

        Raises:
            RuntimeError: the process may have no more threads.
        """
        try:
            worker = self._idle.pop()
        except IndexError:
            worker = _Worker(self)
        worker.give(work, name)

    def rejoin(self, worker: "_Worker") -> bool:
        """Whether a worker that has finished its work waits for more."""
        if self._closed or len(self._idle) >= _MOST_IDLE:
            return False
        self._idle.append(worker)
        if self._closed:  # meanwhile
            return not self.leave(worker)
        return True

    def leave(self, worker: "_Worker") -> bool:
        """Whether an idle worker may end; if not, work is on its way to it."""
        try:
            self._idle.remove(worker)
        except ValueError:
            return False
        return True

    def close(self) -> None:
        """Ends the idle threads; work under way continues. Idempotent."""
        self._closed = True
        for worker in list(self._idle):
            if self.leave(worker):
                worker.dismiss()


class _Worker:
    def __init__(self, pool: ThreadPool) -> None:
        self._pool = pool
        self._work: Work | None = None
        self._handover = threading.Lock()
        self._handover.acquire()
        self._thread: threading.Thread | None = None

    def give(self, work: Work, name: str) -> None:
        self._work = work
        if self._thread is None:
            self._thread = threading.Thread(target=self._main, name=name, daemon=True)
            self._thread.start()
        else:
            self._thread.name = name
        self._handover.release()

    def dismiss(self) -> None:
        """Ends an idle worker."""
        self._handover.release()

    def _main(self) -> None:
        while True:
            if not self._handover.acquire(timeout=_PATIENCE_S):
                if self._pool.leave(self):
                    return
                self._handover.acquire()
            work, self._work = self._work, None
            if work is None:
                return
            try:
                Context().run(work)
            except Exception:
                _logger.exception("work in the thread pool failed")
            del work  # it may hold on to much
            if not self._pool.rejoin(self):
                return
