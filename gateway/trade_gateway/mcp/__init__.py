"""A server of the Model Context Protocol for agents, guarded by rights, locks and, if configured, human approval."""

from typing import TYPE_CHECKING

from trade_gateway._lazy_names import lazy_names

if TYPE_CHECKING:
    from trade_gateway.mcp._approvals import Approvals
    from trade_gateway.mcp._server import converse, serve
    from trade_gateway.mcp._simulation_twin import Twin
    from trade_gateway.mcp._tools import Tools

__all__ = ["Approvals", "Tools", "Twin", "converse", "serve"]

# their modules need the extra `mcp`, which the command line is installed without
__getattr__ = lazy_names(
    __name__,
    {
        "Approvals": "_approvals",
        "converse": "_server",
        "serve": "_server",
        "Twin": "_simulation_twin",
        "Tools": "_tools",
    },
)
