"""The command ``trade``: one module per command, and the output that all of them share."""

import typer

from trade_gateway.cli._app import build, main

__all__ = ["build", "main"]


def __getattr__(name: str) -> typer.Typer:
    if name != "app":
        raise AttributeError(name)
    return build()
