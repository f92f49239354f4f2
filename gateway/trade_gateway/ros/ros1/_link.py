"""Keeps what is open in the ROS 1 node and its pending requests, so that a restarted node receives everything again."""

import itertools
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from trade_gateway.ros._graph import RosRefused, RosUnreachable
from trade_gateway.ros.ros1._child import Child
from trade_gateway.ros.ros1._node._frames import Channel, Head

_AT_ONCE: Final = 16
"""Number of pending requests; each holds a thread of the node."""
_MARGIN_S: Final = 0.5
"""Extra time for the node to report a timeout itself."""
_GONE: Final = "the bridge's ROS 1 node ended meanwhile; whether it was done is unknown"


class _Answer(NamedTuple):
    head: Head
    body: bytes


@dataclass(eq=False)
class Opened:
    """A topic or service that is open in the node."""

    link: "Link"
    number: int
    head: Head
    received: Callable[[Head, bytes], object]
    most: int = 0
    last: bytes | None = None
    """The last message of a latched topic."""

    def send(self, body: bytes) -> None:
        """Publish."""
        self.link.message(self, body)

    def close(self) -> None:
        """Idempotent."""
        self.link.close_one(self)


class Link:
    """Frames to and from the node. `node` reports nodes; `alone` reports that our node ended and sees no others."""

    def __init__(
        self,
        *,
        master: str,
        node: str,
        python: str,
        ip: str,
        changed: Callable[[str, bool], object],
        alone: Callable[[], object],
    ) -> None:
        self._node_changed = changed
        self._alone = alone
        self._numbers = itertools.count(1)
        self._state = threading.Condition()
        self._channel: Channel | None = None
        self._open: dict[int, Opened] = {}
        self._pending_answers: dict[int, Future[_Answer]] = {}
        self._turns = threading.BoundedSemaphore(_AT_ONCE)
        self._closed = False
        self._problem: str | None = None
        self._child = Child(
            master=master,
            node=node,
            python=python,
            ip=ip,
            on_start=self._on_start,
            on_end=self._on_end,
            on_frame=self._on_frame,
        )

    @property
    def healthy(self) -> str:
        """Empty if the node is connected to its master, else why not."""
        if self._closed:
            return "it was closed"
        problem = self._problem
        return self._child.problem if problem is None else problem

    # --- open topics and services

    def open(self, head: Head, received: Callable[[Head, bytes], object], most: int = 0) -> Opened:
        """Opens a topic or service, now and in each restarted node; the callback receives its frames."""
        number = next(self._numbers)
        opened = Opened(self, number, {**head, "id": number, "most": most}, received, most)
        with self._state:
            self._open[number] = opened
            self._put(opened.head)
        return opened

    def names(self, op: str, name: str) -> list[Head]:
        """Returns what is open by this operation under this name."""
        with self._state:
            return [one.head for one in self._open.values() if one.head["op"] == op and one.head["name"] == name]

    def message(self, opened: Opened, body: bytes) -> None:
        with self._state:
            if opened.number in self._open:
                opened.last = body if opened.head["latched"] else None
                self._put({"op": "message", "id": opened.number}, body, key=f"m{opened.number}", most=opened.most)

    def close_one(self, opened: Opened) -> None:
        with self._state:
            if self._open.pop(opened.number, None) is not None:
                self._put({"op": "close", "id": opened.number})

    def reply(self, asked: int, body: bytes, problem: str = "") -> None:
        """Answers a request."""
        with self._state:
            self._put({"op": "reply", "ask": asked, "problem": problem}, body)

    # --- requests

    def ask(self, request: str, head: Head, body: bytes, timeout_s: float, *, stops: bool = False) -> tuple[Any, bytes]:
        """Sends a request to the node; one that stops something does not wait for its turn.

        Raises:
            RosUnreachable, RosRefused: about the `request`.
        """
        deadline = time.monotonic() + timeout_s
        if stops:
            return self._answered(request, head, body, timeout_s, deadline)
        if not self._turns.acquire(timeout=max(timeout_s, 0)):
            raise RosUnreachable(what=request, problem=f"{_AT_ONCE} other requests are pending without an answer")
        try:
            return self._answered(request, head, body, timeout_s, deadline)
        finally:
            self._turns.release()

    def _answered(self, request: str, head: Head, body: bytes, timeout_s: float, deadline: float) -> tuple[Any, bytes]:
        number, answered = self._ask(request, head, body, deadline)
        try:
            answer = answered.result(max(deadline - time.monotonic(), 0) + _MARGIN_S)
        except NotYet:
            raise RosUnreachable(what=request, problem=f"no answer within {timeout_s:.3g} s") from None
        finally:
            with self._state:
                self._pending_answers.pop(number, None)
        return _judged(request, answer)

    def _ask(self, request: str, head: Head, body: bytes, deadline: float) -> tuple[int, "Future[_Answer]"]:
        number = next(self._numbers)
        answered: Future[_Answer] = Future()
        with self._state:
            left_s = max(deadline - time.monotonic(), 0)
            if not self._state.wait_for(lambda: self._channel or self._closed, left_s) or self._closed:
                raise RosUnreachable(what=request, problem=self.healthy)
            self._pending_answers[number] = answered
            left_s = max(deadline - time.monotonic(), 0.05)
            self._put({**head, "ask": number, "timeout_s": left_s}, body)
        return number, answered

    def close(self) -> None:
        """Idempotent."""
        with self._state:
            self._closed = True
            self._open.clear()
            self._state.notify_all()
        self._child.close()

    # --- the node

    def _put(self, head: Head, body: bytes = b"", *, key: str = "", most: int = 0) -> None:
        if self._channel is not None:
            self._channel.put(head, body, key=key, most=most)

    def _on_start(self, channel: Channel) -> None:
        with self._state:
            self._channel = channel
            for opened in self._open.values():
                self._put(opened.head)
                if opened.last is not None:
                    self._put({"op": "message", "id": opened.number}, opened.last)
            self._state.notify_all()

    def _on_end(self) -> None:
        with self._state:
            self._channel, self._problem = None, None
            lost = list(self._pending_answers.values())
            self._pending_answers.clear()
        for answered in lost:
            answered.set_result(_Answer({"failed": "unreachable", "problem": _GONE}, b""))
        self._alone()

    def _on_frame(self, head: Head, body: bytes) -> None:
        match head["op"]:
            case "health":
                self._problem = head["problem"]
            case "node":
                self._node_changed(head["name"], head["there"])
            case "answer":
                with self._state:
                    answered = self._pending_answers.pop(head["ask"], None)
                if answered is not None:
                    answered.set_result(_Answer(head, body))
            case _:
                with self._state:
                    opened = self._open.get(head["id"])
                if opened is not None:
                    opened.received(head, body)
                elif head["op"] == "request":
                    self.reply(head["ask"], b"", "it is not offered any more")


def _judged(request: str, answer: _Answer) -> tuple[Any, bytes]:
    head, body = answer
    match head["failed"]:
        case "unreachable":
            raise RosUnreachable(what=request, problem=head["problem"])
        case "refused":
            raise RosRefused(what=request, problem=head["problem"])
        case _:
            return head["value"], body
