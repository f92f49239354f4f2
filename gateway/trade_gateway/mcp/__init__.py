"""A server of the Model Context Protocol for agents, guarded by rights, locks and, if configured, human approval."""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from trade_gateway.mcp._approvals import Approvals
    from trade_gateway.mcp._server import converse, serve
    from trade_gateway.mcp._simulation_twin import Twin
    from trade_gateway.mcp._tools import Tools

__all__ = ["Approvals", "Tools", "Twin", "converse", "serve"]

_PLACES: Final = {
    "Approvals": "_approvals",
    "converse": "_server",
    "serve": "_server",
    "Twin": "_simulation_twin",
    "Tools": "_tools",
}
"""The modules of these names; they need the extra ``mcp``, which the command line is installed without."""


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(name)
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
