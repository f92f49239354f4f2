"""A system for agents: tools of the Model Context Protocol, guarded by rights, locks and, where marked, a person."""

from trade_gateway.agents._approvals import Approvals
from trade_gateway.agents._server import serve
from trade_gateway.agents._tools import Tools
from trade_gateway.agents._twin import Twin

__all__ = ["Approvals", "Tools", "Twin", "serve"]
