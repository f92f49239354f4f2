"""The provider of the middleware's own services, in group ``trade`` of every container; e-stops have their own."""

from trade._container.assembly import Components
from trade._container.system import System
from trade._container.system_services import SystemServices
from trade._hooks.services import HookServices
from trade._locks.services import LockServices
from trade._migration.services import MigrationServices
from trade._notifications.services import NotificationServices
from trade._notifications.states import StateServices
from trade._streams.services import StreamServices
from trade._tracing.services import TraceServices
from trade.stop_line import GroupStopServices


class OwnServices(
    SystemServices,
    LockServices,
    NotificationServices,
    HookServices,
    TraceServices,
    MigrationServices,
    StreamServices,
    StateServices,
    GroupStopServices,
):
    """One provider, so that one registry entry lists all the container's own services."""

    def __init__(self, parts: Components, system: System) -> None:
        client = parts.client
        SystemServices.__init__(self, system)
        LockServices.__init__(
            self,
            parts.locks,
            client.address,
            parts.ask_for_release,
            parts.lock_api.lease_client.release_requested,
            client.access,
            parts.providers.groups_of,
            parts.remote_locks,
        )
        NotificationServices.__init__(self, parts.notifier, client, parts.sessions.open_session)
        HookServices.__init__(self, parts.hooks, client)
        TraceServices.__init__(self, client.name, parts.spans, parts.trace)
        MigrationServices.__init__(self, parts.migration_source, parts.migration_target)
        StreamServices.__init__(self, parts.streams)
        StateServices.__init__(self, parts.states)
        GroupStopServices.__init__(self, parts.stop_api.stop_for)
