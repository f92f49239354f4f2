"""The one provider of the middleware's own functions: what is in group ``trade`` of every container."""

from trade._access import Access
from trade._arriving import Arriving
from trade._borrowed import Borrowed
from trade._context import current_call
from trade._departing import Departing
from trade._estop_line import EstopReport
from trade._estopping import LIMIT_S, Estopping
from trade._hook_services import HookServices
from trade._hooks import Hooks
from trade._lock_services import Ask, Asked, GroupsOf, LockServices
from trade._locks import LockTable
from trade._making_services import MakingServices
from trade._migration_services import MigrationServices
from trade._notification_services import Home, NotificationServices
from trade._notifications import Notifier
from trade._registry import Registry
from trade._service import service
from trade._spans import Spans
from trade._stream_services import StreamServices
from trade._streams import Streams
from trade._system import System, SystemServices
from trade._trace_services import Switch, TraceServices
from trade._wire import Address, Estop


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

    def __init__(
        self,
        system: System,
        locks: LockTable,
        own: Address,
        ask: Ask,
        asked: Asked,
        estopping: Estopping,
        access: Access,
        groups: GroupsOf,
        borrowed: Borrowed,
        notifier: Notifier,
        registry: Registry,
        hooks: Hooks,
        home: Home,
        spans: Spans,
        trace_here: Switch,
        streams: Streams,
        departing: Departing,
        arriving: Arriving,
    ) -> None:
        SystemServices.__init__(self, system)
        LockServices.__init__(self, locks, own, ask, asked, access, groups, borrowed)
        NotificationServices.__init__(self, notifier, registry, home, access)
        HookServices.__init__(self, hooks, home, access)
        TraceServices.__init__(self, own.container, spans, trace_here)
        MakingServices.__init__(self, system)
        MigrationServices.__init__(self, departing, arriving)
        StreamServices.__init__(self, streams)
        self._estopping = estopping

    @property
    def open_estops(self) -> tuple[Estop, ...]:
        """What its registry entry tells of e-stops."""
        return self._estopping.open_here()

    @service(effect="stop")
    def estop(self, reason: str = "") -> EstopReport:
        """Stop everything in the whole system, and let nothing move until that is cleared; who did, who is missing."""
        call = current_call()
        asked = f"asked by {call.caller}" if call is not None else ""
        return self._estopping.estop(f"{reason} ({asked})" if reason else asked, LIMIT_S)

    @service(effect="read")
    def estops(self) -> list[Estop]:
        """The e-stops that are open anywhere in the system, oldest first."""
        return self._estopping.open()

    @service
    def estop_clear(self, ids: list[str]) -> EstopReport:
        """Clear e-stops by their ids; nothing moves by itself."""
        return self._estopping.clear(ids, LIMIT_S)
