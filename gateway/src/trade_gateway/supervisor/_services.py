"""What everybody may ask of a supervisor, in group ``trade``."""

from trade import current_call, service
from trade.errors import ConfigurationError
from trade_gateway.supervisor._supervisor import ChildInfo, Supervisor

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
