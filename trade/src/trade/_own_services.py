"""The provider of the middleware's own functions: what is in group ``trade`` of every container, e-stops left out."""

from typing import Final, Protocol

from trade._access import Access
from trade._hook_services import HookServices
from trade._lock_services import LockServices
from trade._making_services import MakingServices
from trade._migration_services import MigrationServices
from trade._notification_services import Home as Member
from trade._notification_services import NotificationServices
from trade._parts import Parts
from trade._stream_services import StreamServices
from trade._system import System, SystemServices
from trade._trace_services import TraceServices


class Home(Member, Protocol):
    """The container they belong to."""

    access: Final[Access]
    system: Final[System]


class OwnServices(
    SystemServices,
    LockServices,
    NotificationServices,
    HookServices,
    TraceServices,
    MakingServices,
    MigrationServices,
    StreamServices,
):
    """One provider, so that one registry entry tells of all its container's own functions."""

    def __init__(self, parts: Parts, home: Home) -> None:
        access, locks = home.access, parts.locks
        SystemServices.__init__(self, home.system)
        LockServices.__init__(
            self,
            locks,
            home.address,
            parts.ask_for_release,
            parts.locking.keeper.asked,
            access,
            parts.providers.groups_of,
            parts.borrowed,
        )
        NotificationServices.__init__(self, parts.notifier, parts.registry, home, access)
        HookServices.__init__(self, parts.hooks, home, access)
        TraceServices.__init__(self, home.name, parts.spans, parts.trace)
        MakingServices.__init__(self, home.system)
        MigrationServices.__init__(self, parts.departing, parts.arriving)
        StreamServices.__init__(self, parts.streams)
