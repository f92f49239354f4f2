"""The services of a supervisor, in group ``trade``."""

from trade import current_call, service
from trade.errors import ConfigurationError
from trade_gateway.supervisor._child_state import ChildInfo
from trade_gateway.supervisor._lease import Lease
from trade_gateway.supervisor._supervisor import Supervisor

__all__ = ["ChildServices"]


class ChildServices:
    """Offers a supervisor's functions as services."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor

    @service(effect="read")
    def children(self) -> list[ChildInfo]:
        """The containers that this gateway supervises, and their state."""
        return self._supervisor.children()

    @service
    def restart_child(self, name: str) -> None:
        """Restart a container that this gateway supervises, also if it was given up."""
        call = current_call()
        if not self._supervisor.restart(name, "a local caller" if call is None else call.caller):
            known = ", ".join(info.name for info in self._supervisor.children()) or "none"
            raise ConfigurationError(where="trade.restart_child", problem=f"no child {name!r}; there is {known}")

    @service
    def lease_child(self, name: str, gateway: str, turn: str) -> Lease:
        """Lease a container to the gateway that this one is the standby for, or renew the lease."""
        return self._supervisor.stand_in(name).lease(self._caller(), gateway, turn)

    @service
    def keep_child(self, name: str, gateway: str, turn: str, number: int, states: bytes) -> bool:
        """Save the states of a container of the gateway that this one is the standby for."""
        return self._supervisor.stand_in(name).keep_for(self._caller(), gateway, turn, number, states)

    @service
    def hand_back_child(self, name: str) -> None:
        """End a container that runs here as standby, and hand it back to its gateway with its state."""
        self._supervisor.stand_in(name).hand_back()

    def _caller(self) -> str | None:
        """Returns the caller's identity; None without certificates."""
        call = current_call()
        return None if call is None or not self._supervisor.certified else call.caller
