"""The dashboard: one page that people operate a system with. It speaks to the door like any other client."""

from trade_gateway.dashboard._files import pages

__all__ = ["pages"]
