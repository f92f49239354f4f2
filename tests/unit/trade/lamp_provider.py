"""A lamp that is called in a whole system in memory."""

from collections.abc import Callable

from trade import Container, Handle, service, where
from trade.testing import MemorySystem

Pair = Callable[[MemorySystem], tuple[Container, Container, Handle]]
"""Starts a caller and a callee; returns both, and the caller's handle of the callee's lamp."""


class Lamp:
    def __init__(self) -> None:
        self.values: list[float] = []

    @service
    def dim(self, value: float) -> float:
        self.values.append(value)
        return value


def labels(container: Container) -> list[str]:
    """What it knows of, the middleware's own left out."""
    return [f"{handle.container}/{handle.label}" for handle in container.services() if handle.key.domain != "trade"]


def found(container: Container, group: str = "robot") -> Handle:
    return container.find(where(name="dim", group=group), wait_s=20).with_(deadline_s=20)
