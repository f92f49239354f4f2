"""Containers as child processes: started in order, asked whether they answer, started again, their state kept."""

from trade_gateway.supervisor._services import ChildServices
from trade_gateway.supervisor._supervisor import Supervisor
from trade_gateway.supervisor._tables import Child, read_children
from trade_gateway.supervisor._unit import ChildInfo, News

__all__ = ["Child", "ChildInfo", "ChildServices", "News", "Supervisor", "read_children"]
