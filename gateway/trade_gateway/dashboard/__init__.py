"""The dashboard: a web page for operators of a system. It uses the HTTP API like any other client."""

from trade_gateway.dashboard._files import pages

__all__ = ["pages"]
