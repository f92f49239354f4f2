"""A ROS 1 service server: it runs requests in turn, or each at once, and answers every request."""

import threading
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from trade_gateway.ros._graph import Answer
from trade_gateway.ros._mailbox import Mailbox
from trade_gateway.ros.ros1._node._frames import Head
from trade_gateway.ros_messages._types import Types

_MOST: Final = 32
"""Number of requests that wait."""
_LATE_S: Final = 5.0
"""A request that waited longer is refused, not executed; its client has given up."""
_AT_ONCE: Final = 64
"""Threads of a service that stops something. When all are in use, further requests are answered in order."""

Reply = Callable[[int, bytes, str], object]
"""Receives the number of a request, the bytes of its response, and the error instead of it."""


class _Request(NamedTuple):
    asked: int
    body: bytes
    who: str
    at: float


class Served:
    """See the module. A service that `stops` something refuses no request for its age or for a full queue."""

    def __init__(
        self, types: Types, name: str, type_name: str, answer: Answer, reply: Reply, *, stops: bool = False
    ) -> None:
        self._types = types
        self._request, self._response = types.parts(type_name)
        self._answer = answer
        self._reply = reply
        self._stops = stops
        self._name = f"trade-ros1{name}"
        self._lock = threading.Lock()
        self._closed = False
        self._waiting: set[int] = set()
        self._threads = 0
        self._mailbox = Mailbox(self._name, self._do, end_s=0.0)

    def came(self, head: Head, body: bytes) -> None:
        """Handles a request."""
        request = _Request(head["ask"], body, head["who"], head["at"])
        with self._lock:
            refused = "the service was withdrawn" if self._closed else ""
            if not self._stops and len(self._waiting) >= _MOST:
                refused = refused or f"{_MOST} requests wait already"
            if not refused:
                self._waiting.add(request.asked)
            alone = self._stops and not refused and self._threads < _AT_ONCE
            self._threads += alone
        if refused:
            self._reply(request.asked, b"", refused)
        elif not (alone and self._begun(request)):
            self._mailbox.put(request)

    def close(self) -> None:
        """Refuses all waiting requests. Idempotent."""
        self._mailbox.close()
        with self._lock:
            self._closed = True
            waiting, self._waiting = self._waiting, set()
        for asked in waiting:
            self._reply(asked, b"", "the service was withdrawn")

    def _begun(self, request: _Request) -> bool:
        """Whether a new thread answers it."""
        try:
            threading.Thread(target=self._do_alone, args=(request,), name=self._name, daemon=True).start()
        except RuntimeError:  # the thread limit is reached
            self._ended()
            return False
        return True

    def _do_alone(self, request: _Request) -> None:
        try:
            self._do(request)
        finally:
            self._ended()

    def _ended(self) -> None:
        with self._lock:
            self._threads -= 1

    def _do(self, request: _Request) -> None:
        try:
            answer, problem = self._answered(request), ""
        except Exception as error:  # noqa: BLE001 - reported to the caller, whatever it is
            answer, problem = b"", str(error) or type(error).__name__
        with self._lock:
            waited = request.asked in self._waiting
            self._waiting.discard(request.asked)
        if waited:
            self._reply(request.asked, answer, problem)

    def _answered(self, request: _Request) -> bytes:
        if not self._stops and time.monotonic() - request.at > _LATE_S:
            raise TimeoutError("not executed: it waited too long behind other requests")
        given = self._answer(self._types.from_bytes(self._request, request.body), request.who, request.at)
        return self._types.to_bytes(self._response, given)
