"""The command ``trade``, a module a command, and how all of them print."""

from trade_gateway.cli._app import build, main

__all__ = ["build", "main"]
