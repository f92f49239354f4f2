"""One thing measured in a fresh process: its arguments go in, what it returns comes back."""

from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TypeVar

from tests.bench._children import child, hear

_Result = TypeVar("_Result")


def alone(function: Callable[..., _Result], *arguments: object, patience_s: float = 60.0) -> _Result:
    """Call it in a process of its own.

    Args:
        function: one of a module, as it is sent by name.
        arguments: plain data.
        patience_s: how long it may take.
    """
    with child(_run, function, arguments) as pipe:
        return hear(pipe, patience_s)


def _run(pipe: Connection, function: Callable[..., object], arguments: tuple[object, ...]) -> None:
    pipe.send(function(*arguments))
