"""The services of a supervisor, in group ``trade``."""

from collections.abc import Callable

from trade import current_call, service
from trade.errors import ConfigurationError
from trade_gateway.supervisor._child_state import ChildInfo
from trade_gateway.supervisor._described import ChildTables
from trade_gateway.supervisor._lease import Lease
from trade_gateway.supervisor._supervisor import Supervisor


class ChildServices:
    """Offers a supervisor's functions as services.

    Args:
        supervisor: the supervisor.
        described: returns the tables of its containers; None: they are of no file.
    """

    def __init__(self, supervisor: Supervisor, described: Callable[[], ChildTables] | None = None) -> None:
        self._supervisor = supervisor
        self._described = described

    @service(effect="read")
    def children(self) -> list[ChildInfo]:
        """The containers that this gateway supervises, and their state."""
        return self._supervisor.children()

    @service(effect="read")
    def child_tables(self) -> ChildTables:
        """The tables of the containers that this gateway supervises, as its file says, with absolute paths."""
        return ChildTables("", {}, {}) if self._described is None else self._described()

    @service
    def restart_child(self, name: str) -> None:
        """Restart a container that this gateway supervises, also if it was given up."""
        self._require(self._supervisor.restart(name, _who()), "restart_child", name)

    @service
    def stop_child(self, name: str) -> None:
        """End a container that this gateway supervises; restart_child starts it again."""
        self._require(self._supervisor.stop(name, _who()), "stop_child", name)

    def _require(self, known: bool, function: str, name: str) -> None:
        if not known:
            there = ", ".join(info.name for info in self._supervisor.children()) or "none"
            raise ConfigurationError(where=f"trade.{function}", problem=f"no child {name!r}; there is {there}")

    @service
    def lease_child(self, name: str, gateway: str, turn: str) -> Lease:
        """Lease a container to the gateway that this one is the standby for, or renew the lease."""
        return self._supervisor.standby_of(name).lease(self._caller(), gateway, turn)

    @service
    def keep_child(self, name: str, gateway: str, turn: str, number: int, states: bytes) -> bool:
        """Save the states of a container of the gateway that this one is the standby for."""
        return self._supervisor.standby_of(name).keep_for(self._caller(), gateway, turn, number, states)

    @service
    def hand_back_child(self, name: str) -> None:
        """End a container that runs here as standby, and hand it back to its gateway with its state."""
        self._supervisor.standby_of(name).hand_back()

    def _caller(self) -> str | None:
        """Returns the caller's identity; None without certificates."""
        call = current_call()
        return None if call is None or not self._supervisor.certified else call.caller


def _who() -> str:
    call = current_call()
    return "a local caller" if call is None else call.caller
