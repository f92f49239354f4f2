"""The command ``trade``, a module a command, and how all of them print."""

import typer

from trade_gateway.cli._app import build, main

__all__ = ["build", "main"]


def __getattr__(name: str) -> typer.Typer:
    if name != "app":
        raise AttributeError(name)
    return build()
