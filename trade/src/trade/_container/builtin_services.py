"""The provider of the middleware's own functions: what is in group ``trade`` of every container, e-stops left out."""

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
from trade._security.authorizer import Authorizer
from trade._services.decorator import service
from trade._streams.services import StreamServices
from trade._telemetry.log_buffer import LogLine, logbook
from trade._telemetry.spans import Span, Spans

Switch = Callable[[bool], bool]


class TraceServices:
    """The wire's side of `Spans` and `Logbook`."""

    def __init__(self, container: str, spans: Spans, switch: Switch) -> None:
        self._teller = container
        self._noted = spans
        self._switch = switch

    @service
    def set_tracing(self, on: bool) -> bool:
        """Note every call that this container makes and serves; off: what was noted stays. Whether it was on before."""
        return self._switch(on)

    @service(effect="read")
    def spans(self, calls: list[int] | None = None, after: int = 0) -> list[Span]:
        """What this container noted above that number, of these calls and those they led to, or all; oldest first."""
        return self._noted.kept(None if calls is None else frozenset(calls), after)

    @service(effect="read")
    def log_lines(self, after: int = 0) -> list[LogLine]:
        """What the process logged lately, of its lines after that one."""
        return [structs.replace(line, container=self._teller) for line in logbook.lines(after)]


class ServicesHost(Member, Protocol):
    """The container they belong to."""

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
):
    """One provider, so that one registry entry tells of all its container's own functions."""

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
        HookServices.__init__(self, parts.hooks, home, access)
        TraceServices.__init__(self, home.name, parts.spans, parts.trace)
        FactoryServices.__init__(self, home.system)
        MigrationServices.__init__(self, parts.migration_source, parts.migration_target)
        StreamServices.__init__(self, parts.streams)
