"""The provider of the middleware's own services, in group ``trade`` of every container; e-stops have their own."""

from collections.abc import Callable
from typing import Final, Protocol

from msgspec import structs

from trade._container.assembly import Components
from trade._container.system import System, SystemServices
from trade._hooks.services import HookServices
from trade._locks.services import LockServices
from trade._migration.services import FactoryServices, MigrationServices
from trade._notifications.services import NotificationServices
from trade._notifications.services import NotificationServicesHost as Member
from trade._notifications.states import StateServices
from trade._security.authorizer import Authorizer
from trade._services.decorator import service
from trade._stop_line import GroupStopServices
from trade._streams.services import StreamServices
from trade._telemetry.log_buffer import LogLine, logbook
from trade._telemetry.spans import Span, Spans

Switch = Callable[[bool], bool]


class TraceServices:
    """The services of `Spans` and `Logbook`."""

    def __init__(self, container: str, spans: Spans, switch: Switch) -> None:
        self._container = container
        self._noted = spans
        self._switch = switch

    @service
    def set_tracing(self, on: bool) -> bool:
        """Traces every call that this container makes and serves, or stops that. Returns whether it was on."""
        return self._switch(on)

    @service(effect="read")
    def spans(self, calls: list[int] | None = None, after: int = 0) -> list[Span]:
        """The spans after that number, of these calls and those they led to, or of all; oldest first."""
        return self._noted.kept(None if calls is None else frozenset(calls), after)

    @service(effect="read")
    def log_lines(self, after: int = 0) -> list[LogLine]:
        """The recent log lines of the process after that one."""
        return [structs.replace(line, container=self._container) for line in logbook.lines(after)]


class ServicesHost(Member, Protocol):
    """The container of these services."""

    access: Final[Authorizer]
    system: Final[System]


class OwnServices(
    SystemServices,
    LockServices,
    NotificationServices,
    HookServices,
    TraceServices,
    FactoryServices,
    MigrationServices,
    StreamServices,
    StateServices,
    GroupStopServices,
):
    """One provider, so that one registry entry lists all the container's own services."""

    def __init__(self, parts: Components, home: ServicesHost) -> None:
        access, locks = home.access, parts.locks
        SystemServices.__init__(self, home.system)
        LockServices.__init__(
            self,
            locks,
            home.address,
            parts.ask_for_release,
            parts.lock_api.lease_client.asked,
            access,
            parts.providers.groups_of,
            parts.remote_locks,
        )
        NotificationServices.__init__(self, parts.notifier, parts.registry, home, access)
        HookServices.__init__(self, parts.hooks, parts.registry, home, access)
        TraceServices.__init__(self, home.name, parts.spans, parts.trace)
        FactoryServices.__init__(self, home.system)
        MigrationServices.__init__(self, parts.migration_source, parts.migration_target)
        StreamServices.__init__(self, parts.streams)
        StateServices.__init__(self, parts.states)
        GroupStopServices.__init__(self, parts.stop_for)
