"""The one provider of the middleware's own functions: what is in group ``trade`` of every container."""

from collections.abc import Callable

from trade._access import Access
from trade._lock_services import Ask, Asked, GroupsOf, LockServices
from trade._locks import LockTable
from trade._system import System, SystemServices
from trade._wire import Address, Estop

Open = Callable[[], tuple[Estop, ...]]


class OwnServices(SystemServices, LockServices):
    """One provider, so that one registry entry tells of all its container's own functions."""

    def __init__(
        self,
        system: System,
        locks: LockTable,
        own: Address,
        ask: Ask,
        asked: Asked,
        open_estops: Open,
        access: Access,
        groups: GroupsOf,
    ) -> None:
        SystemServices.__init__(self, system)
        LockServices.__init__(self, locks, own, ask, asked, access, groups)
        self._open_estops = open_estops

    @property
    def open_estops(self) -> tuple[Estop, ...]:
        """What its registry entry tells of e-stops."""
        return self._open_estops()
