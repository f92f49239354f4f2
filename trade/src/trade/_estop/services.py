"""E-stops as services of every container, and the registry entry that tells which are open there.

They are a provider of their own because its entry is told anew with every e-stop, by everybody to everybody: it is a
twelfth of that of all other functions of the middleware.
"""

from trade._context.call_context import current_call
from trade._estop.broadcast import EstopReport
from trade._estop.controller import EstopController
from trade._protocol.messages import Estop
from trade._services.decorator import service


class EstopServices:
    """For whoever only speaks the wire, or is no program of ours."""

    def __init__(self, estopping: EstopController) -> None:
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
        return self._estopping.estop(f"{reason} ({asked})" if reason else asked)

    @service(effect="read")
    def estops(self) -> list[Estop]:
        """The e-stops that are open anywhere in the system, oldest first."""
        return self._estopping.estops()

    @service
    def estop_clear(self, ids: list[str]) -> EstopReport:
        """Clear e-stops by their ids; nothing moves by itself."""
        return self._estopping.estop_clear(ids)
