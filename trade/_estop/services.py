"""The e-stop services of every container, and the registry entry that lists its open e-stops.

They have their own provider because every container sends its entry to all others at every e-stop: the entry is a
twelfth of that of all other functions of the middleware.
"""

from trade._context.call_context import current_call
from trade._estop.broadcast import EstopReport
from trade._estop.controller import LIMIT_S, EstopController
from trade._services.decorator import service
from trade.protocol.messages import Estop


class EstopServices:
    """E-stops for clients that use only the wire protocol, in any language."""

    def __init__(self, estopping: EstopController) -> None:
        self._estopping = estopping

    @property
    def open_estops(self) -> tuple[Estop, ...]:
        """The open e-stops, for the registry entry."""
        return self._estopping.open_here()

    @service(effect="stop")
    def estop(self, reason: str = "", estop_id: str = "", limit_s: float = LIMIT_S) -> EstopReport:
        """Stops everything in the whole system until the e-stop is cleared; reports which containers did, or failed.

        With the id of an e-stop that the caller has given, it gives the same one to all containers that it sees.
        """
        call = current_call()
        asked = f"asked by {call.caller}" if call is not None else ""
        why = f"{reason} ({asked})" if reason else asked
        if estop_id:
            return self._estopping.relay(estop_id, why, limit_s, beyond=True)
        return self._estopping.estop(why, limit_s=limit_s)

    @service(effect="read")
    def estops(self) -> list[Estop]:
        """The e-stops that are open anywhere in the system, oldest first."""
        return self._estopping.estops()

    @service
    def estop_clear(self, ids: list[str]) -> EstopReport:
        """Clears e-stops by their ids; nothing moves by itself."""
        return self._estopping.estop_clear(ids)
