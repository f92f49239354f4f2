"""A ROS system as the bridge sees it; what differs between ROS 1 and ROS 2 is behind this.

Names are ROS names (``/arm/joint_states``); types are written ``package/msg/Name``, ``package/srv/Name`` and
``package/action/Name`` for both; messages are dicts, see `Types`.

Callbacks are called on threads of the graph, one at a time for each subscription or service; they may wait. What a
graph has open it opens again by itself when its peer (the master, the router) was gone; nothing needs to be asked for
twice.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from trade.errors import CallerError, CallError
from trade_gateway.ros._types import Message, Types

__all__ = [
    "Answer",
    "Closes",
    "Ended",
    "Goal",
    "Graph",
    "Heard",
    "NodeTold",
    "Outcome",
    "Publisher",
    "Pursuit",
    "RosRefused",
    "RosUnreachable",
]

Heard = Callable[[Message, str], object]
"""Told of a message, and of the name of the node that sent it (``/teleop``; empty if ROS does not say)."""
Answer = Callable[[Message, str, float], Message]
"""Given a request, the caller's name and when it came (``time.monotonic()``, before it waited for anything), returns
the response; what it raises is told to the caller as a failure."""
NodeTold = Callable[[str, bool], object]
"""Told of a node by name, and whether it is there (or is gone, or can no longer be seen)."""


@dataclass(kw_only=True, eq=False)
class RosUnreachable(CallError, ConnectionError):
    """What was asked for is not there: no master, no router, no server; or it did not answer in time."""

    what: str
    problem: str

    def describe(self) -> str:
        return f"{self.what}: {self.problem}"


@dataclass(kw_only=True, eq=False)
class RosRefused(CallerError):
    """The other side of ROS was asked and said no."""

    what: str
    problem: str

    def describe(self) -> str:
        return f"{self.what}: {self.problem}"


class Ended(Enum):
    """How a goal of an action ended."""

    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


@dataclass(frozen=True)
class Outcome:
    """The end of a goal."""

    how: Ended
    result: Message
    text: str = ""


class Closes(Protocol):
    """Something open."""

    def close(self) -> None:
        """End it. Idempotent."""
        ...


class Publisher(Closes, Protocol):
    """A topic that is published."""

    def send(self, message: Mapping[str, Any]) -> None:
        """Publish; fields left out are zero. Does not wait. Raises ConfigurationError: it does not fit the type."""
        ...


class Goal(Protocol):
    """A goal that somebody has sent to an action of ours."""

    @property
    def message(self) -> Message: ...

    @property
    def client(self) -> str:
        """Name of the node that sent it."""
        ...

    @property
    def came_at(self) -> float:
        """When it came, by ``time.monotonic()``, before it waited for anything."""
        ...

    def feedback(self, message: Mapping[str, Any]) -> None:
        """Tell how far it is."""
        ...

    def when_canceled(self, tell: Callable[[], object]) -> None:
        """Have this called when its client asks for its end, or another goal takes its place; at once if it has."""
        ...


class Pursuit(Protocol):
    """A goal of ours at an action of theirs."""

    def wait(self, timeout_s: float) -> Outcome:
        """Its end.

        Raises:
            RosRefused: it was rejected.
            RosUnreachable: its server is gone, or nothing was heard of its end in time.
        """
        ...

    def cancel(self) -> None:
        """Ask for its end; does not wait for it."""
        ...


class Graph(Protocol):
    """See the module."""

    @property
    def types(self) -> Types: ...

    def advertise(self, topic: str, type_name: str, *, latched: bool = False) -> Publisher:
        """Publish a topic; latched: who comes later is given the last message."""
        ...

    def subscribe(self, topic: str, type_name: str, heard: Heard, *, latched: bool = False) -> Closes:
        """Hear a topic; latched: also what was published before, if its publisher keeps that.

        Otherwise that is not told: an old command would be taken for a new one.
        """
        ...

    def serve(self, name: str, type_name: str, answer: Answer, *, stops: bool = False) -> Closes:
        """Offer a service; stops: each request is answered at once, on a thread of its own, and waits for no other."""
        ...

    def call(
        self, name: str, type_name: str, request: Mapping[str, Any], timeout_s: float, *, stops: bool = False
    ) -> Message:
        """Call a service of theirs; stops: however many other calls are under way.

        Raises:
            RosUnreachable: it is not there, or did not answer in time.
            RosRefused: it failed.
        """
        ...

    def act(self, name: str, type_name: str, do: Callable[[Goal], Outcome]) -> Closes:
        """Offer an action; each goal on a thread of its own, a later one cancels the one before."""
        ...

    def pursue(
        self, name: str, type_name: str, goal: Mapping[str, Any], feedback: Callable[[Message], object] | None = None
    ) -> Pursuit:
        """Send a goal to an action of theirs. Raises RosUnreachable: nobody serves it."""
        ...

    def parameters(self, node: str, timeout_s: float) -> dict[str, Any]:
        """What a node (ROS 1: a namespace) has as parameters, by name. Raises RosUnreachable, RosRefused."""
        ...

    def set_parameter(self, node: str, name: str, value: Any, timeout_s: float) -> None:
        """Set one. Raises RosUnreachable, RosRefused."""
        ...

    def watch_nodes(self, told: NodeTold) -> Closes:
        """Have nodes told of that come and go, first those that are there. A node that dies is told gone in seconds."""
        ...

    @property
    def healthy(self) -> str:
        """Empty, or what is wrong: ``no master at http://...`` ."""
        ...

    def close(self) -> None:
        """End all. Idempotent."""
        ...
