"""A server of the Model Context Protocol for agents, guarded by rights, locks and, if configured, human approval."""

from trade._protocol.schema_types import publish as _publish
from trade_gateway.mcp._approvals import Approvals, Request
from trade_gateway.mcp._server import converse, serve
from trade_gateway.mcp._simulation_twin import Twin
from trade_gateway.mcp._tools import Tools

__all__ = ["Approvals", "Tools", "Twin", "converse", "serve"]

_publish(__name__, Request)
