"""Supervision of containers as child processes: ordered start, health checks, restarts, saved state."""

from trade.protocol.schema_types import publish as _publish
from trade_gateway.config._children import Child, read_children
from trade_gateway.supervisor._child_state import ChildInfo, News
from trade_gateway.supervisor._described import ChildTables
from trade_gateway.supervisor._lease import Lease
from trade_gateway.supervisor._services import ChildServices
from trade_gateway.supervisor._supervisor import Supervisor

__all__ = ["Child", "ChildInfo", "ChildServices", "ChildTables", "News", "Supervisor", "read_children"]

_publish(__name__, ChildInfo, ChildTables, Lease)
