"""A service of ours: requests one after the other, and every one of them is answered."""

import threading
from collections.abc import Callable
from typing import Final

from trade_gateway.ros._graph import Answer
from trade_gateway.ros._types import Types
from trade_gateway.ros.ros1._lane import Lane
from trade_gateway.ros.ros1._node._frames import Head

__all__ = ["Served"]

_MOST: Final = 32
"""Requests that wait."""

Reply = Callable[[int, bytes, str], object]
"""Given the number of a request, the bytes of its response, and what failed instead."""


class Served:
    """See the module."""

    def __init__(self, types: Types, name: str, type_name: str, answer: Answer, reply: Reply) -> None:
        self._types = types
        self._request, self._response = types.parts(type_name)
        self._answer = answer
        self._reply = reply
        self._lock = threading.Lock()
        self._waiting: set[int] = set()
        self._lane = Lane(f"trade-ros1{name}")

    def came(self, head: Head, body: bytes) -> None:
        """A request."""
        asked = head["ask"]
        with self._lock:
            full = len(self._waiting) >= _MOST
            if not full:
                self._waiting.add(asked)
        if full:
            self._reply(asked, b"", f"{_MOST} requests wait already")
        else:
            self._lane.put(lambda: self._do(asked, body, head["who"], head["at"]))

    def close(self) -> None:
        """Whoever waits is told. Idempotent."""
        self._lane.close()
        with self._lock:
            waiting, self._waiting = self._waiting, set()
        for asked in waiting:
            self._reply(asked, b"", "the service was withdrawn")

    def _do(self, asked: int, body: bytes, who: str, at: float) -> None:
        try:
            given = self._answer(self._types.from_bytes(self._request, body), who, at)
            answer, problem = self._types.to_bytes(self._response, given), ""
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the caller's to know
            answer, problem = b"", str(error) or type(error).__name__
        with self._lock:
            waited = asked in self._waiting
            self._waiting.discard(asked)
        if waited:
            self._reply(asked, answer, problem)
