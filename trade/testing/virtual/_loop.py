"""An event loop of asyncio whose waits are in the scheduler."""

import asyncio
from typing import Any

from trade.testing.virtual._descriptors import Descriptors, Selector
from trade.testing.virtual._scheduler import Scheduler, VirtualTimeError


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self, scheduler: Scheduler, files: Descriptors) -> None:
        self._scheduler = scheduler
        super().__init__(Selector(files))

    def time(self) -> float:
        return self._scheduler.monotonic_ns() / 1e9


def _refused(name: str) -> Any:
    async def refuse(*_: Any, **_named: Any) -> None:
        raise VirtualTimeError(f"asyncio's {name} was called: virtual time has its TCP sockets only")

    return refuse


for _name in ("create_datagram_endpoint", "create_unix_connection", "create_unix_server"):
    setattr(_Loop, _name, _refused(_name))


class Policy(asyncio.DefaultEventLoopPolicy):
    """Makes event loops on virtual time."""

    def __init__(self, scheduler: Scheduler, files: Descriptors) -> None:
        super().__init__()
        self._scheduler, self._files = scheduler, files

    def new_event_loop(self) -> Any:
        return _Loop(self._scheduler, self._files)
