"""An event loop of asyncio whose waits are in the scheduler."""

import asyncio
import selectors
from collections import deque
from typing import Any

from trade.testing.virtual._scheduler import Scheduler, VirtualTimeError, WaitList


class _Selector(selectors.SelectSelector):
    """Waits in the scheduler, and looks at real files only between waits."""

    def __init__(self, scheduler: Scheduler) -> None:
        super().__init__()
        self._scheduler = scheduler
        self._waiting: WaitList = deque()
        self._woken = False

    def wake(self) -> None:
        """End a wait, from any thread."""
        self._woken = True
        self._scheduler.wake_all(self._waiting)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(0)
        if not found and not self._woken and (timeout is None or timeout > 0):
            self._scheduler.wait([self._waiting], timeout)
            found = super().select(0)
        self._woken = False
        return found


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self, scheduler: Scheduler) -> None:
        self._virtual, self._scheduler = _Selector(scheduler), scheduler
        super().__init__(self._virtual)

    def time(self) -> float:
        return self._scheduler.monotonic_ns() / 1e9

    def _write_to_self(self) -> None:
        self._virtual.wake()


def _refused(name: str) -> Any:
    async def refuse(*_: Any, **_named: Any) -> None:
        raise VirtualTimeError(f"asyncio's {name} was called: virtual time has sockets of threads only")

    return refuse


for _name in ("create_connection", "create_server", "create_unix_connection", "create_unix_server"):
    setattr(_Loop, _name, _refused(_name))


class Policy(asyncio.DefaultEventLoopPolicy):
    """Makes event loops on virtual time."""

    def __init__(self, scheduler: Scheduler) -> None:
        super().__init__()
        self._scheduler = scheduler

    def new_event_loop(self) -> Any:
        return _Loop(self._scheduler)
