"""The middleware's own functions as services, in group ``trade`` of every container."""

import time
from typing import Final

from msgspec import Struct

from trade._service import service

DOMAIN: Final = "trade"
PROVIDER: Final = "system"
CLOCK: Final = "clock"


class ContainerInfo(Struct, frozen=True):
    """One container as another one knows it."""

    name: str
    identity: str
    epoch: str
    host: str
    pid: int
    providers: int
    services: int


class SystemServices:
    """What every container offers about itself."""

    @service(effect="read")
    def clock(self) -> int:
        """Monotonic clock of this container, in nanoseconds; the basis of every expiry."""
        return time.monotonic_ns()
