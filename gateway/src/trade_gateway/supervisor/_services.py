"""What everybody may ask of a supervisor, in group ``trade``."""

from trade import current_call, service
from trade.errors import ConfigurationError
from trade_gateway.supervisor._child import ChildInfo
from trade_gateway.supervisor._lease import Lease
from trade_gateway.supervisor._supervisor import Supervisor

__all__ = ["ChildServices"]


class ChildServices:
    """The wire's side of a supervisor."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor

    @service(effect="read")
    def children(self) -> list[ChildInfo]:
        """The containers that this gateway looks after, and how they fare."""
        return self._supervisor.children()

    @service
    def restart_child(self, name: str) -> None:
        """End a container that this gateway looks after, and start it again, also if it was given up."""
        call = current_call()
        if not self._supervisor.restart(name, "somebody" if call is None else call.caller):
            known = ", ".join(info.name for info in self._supervisor.children()) or "nobody"
            raise ConfigurationError(where="trade.restart_child", problem=f"no child {name!r}; there is {known}")

    @service
    def lease_child(self, name: str, gateway: str, turn: str) -> Lease:
        """Let the gateway that this one stands in for have a container for a while, or go on having it."""
        return self._supervisor.stand_in(name).lease(self._caller(), gateway, turn)

    @service
    def keep_child(self, name: str, gateway: str, turn: str, number: int, states: bytes) -> bool:
        """Keep what a container knows that the gateway has which this one stands in for."""
        return self._supervisor.stand_in(name).keep_for(self._caller(), gateway, turn, number, states)

    @service
    def hand_back_child(self, name: str) -> None:
        """End a container here that is here for another gateway, and let that one have it again, with its state."""
        self._supervisor.stand_in(name).hand_back()

    def _caller(self) -> str | None:
        """Who asks; None where links do not tell."""
        call = current_call()
        return None if call is None or not self._supervisor.certified else call.caller
