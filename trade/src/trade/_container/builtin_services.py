"""The provider of the middleware's own functions: what is in group ``trade`` of every container, e-stops left out."""

from typing import Final, Protocol

from trade._container.assembly import Parts
from trade._container.system import System, SystemServices
from trade._container.trace_services import TraceServices
from trade._hooks.services import HookServices
from trade._locks.services import LockServices
from trade._migration.factory_services import MakingServices
from trade._migration.services import MigrationServices
from trade._notifications.services import Home as Member
from trade._notifications.services import NotificationServices
from trade._security.authorizer import Access
from trade._streams.services import StreamServices


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
