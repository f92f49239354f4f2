"""The interface of a ROS system to the bridge; it hides the differences between ROS 1 and ROS 2.

Names are ROS names (``/arm/joint_states``); types are written ``package/msg/Name``, ``package/srv/Name`` and
``package/action/Name`` for both; messages are dicts, see `Types`.

Callbacks run on threads of the graph, one at a time for each subscription or service; they may wait. After its peer
(the master, the router) was unreachable, a graph reopens everything that was open by itself; callers need not repeat
anything.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from trade.errors import CallerError, CallError
from trade_gateway.ros_messages._types import Message, Types

Heard = Callable[[Message, str], object]
"""Receives a message and the name of the node that sent it (``/teleop``; empty if ROS does not say)."""
Answer = Callable[[Message, str, float], Message]
"""Takes a request, the caller's name and its time of arrival (``time.monotonic()``, before any wait), returns
the response; an exception is reported to the caller as a failure."""
NodeListener = Callable[[str, bool], object]
"""Receives a node's name, and whether it is present (False: it is gone, or not visible any more)."""


@dataclass(kw_only=True, eq=False)
class RosUnreachable(CallError, ConnectionError):
    """A master, router or server does not exist, or did not answer in time."""

    what: str
    problem: str

    def describe(self) -> str:
        return f"{self.what}: {self.problem}"


@dataclass(kw_only=True, eq=False)
class RosRefused(CallerError):
    """The other side of ROS refused the request."""

    what: str
    problem: str

    def describe(self) -> str:
        return f"{self.what}: {self.problem}"


class GoalEnd(Enum):
    """How a goal of an action ended."""

    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


@dataclass(frozen=True)
class Outcome:
    """The end of a goal."""

    how: GoalEnd
    result: Message
    text: str = ""


class Closable(Protocol):
    """Something open that can be closed."""

    def close(self) -> None:
        """Closes it. Idempotent."""
        ...


class Publisher(Closable, Protocol):
    """A published topic."""

    def send(self, message: Mapping[str, Any]) -> None:
        """Publishes a message; missing fields are zero. Does not wait. Raises ConfigurationError: it does not fit."""
        ...


class Goal(Protocol):
    """A goal that a client has sent to an action of TRADE."""

    @property
    def message(self) -> Message: ...

    @property
    def client(self) -> str:
        """Name of the node that sent it."""
        ...

    @property
    def came_at(self) -> float:
        """Its time of arrival by ``time.monotonic()``, before any wait."""
        ...

    def feedback(self, message: Mapping[str, Any]) -> None:
        """Sends feedback to the client."""
        ...

    def when_canceled(self, callback: Callable[[], object]) -> None:
        """Registers a callback for a cancel by its client or a replacement; it runs at once if that has happened."""
        ...


Refuse = Callable[[Message], Outcome | None]
"""Takes the message of a goal that has arrived; None: it can be carried out. Else why it cannot: ROS 1 reports all of
it, ROS 2 only that it was rejected."""


class ActionGoal(Protocol):
    """A goal that TRADE sent to an action of ROS."""

    def wait(self, timeout_s: float) -> Outcome:
        """Waits for its end.

        Raises:
            RosRefused: it was rejected.
            RosUnreachable: its server is gone, or no end was received in time.
        """
        ...

    def cancel(self) -> None:
        """Requests its end; does not wait for it."""
        ...


class Graph(Protocol):
    """A ROS system. See the module."""

    @property
    def types(self) -> Types: ...

    def advertise(self, topic: str, type_name: str, *, latched: bool = False) -> Publisher:
        """Publishes a topic; latched: later subscribers receive the last message."""
        ...

    def subscribe(self, topic: str, type_name: str, callback: Heard, *, latched: bool = False) -> Closable:
        """Subscribes to a topic; latched: also receives earlier messages, if the publisher keeps them.

        Otherwise earlier messages are dropped: an old command would be taken for a new one.
        """
        ...

    def serve(self, name: str, type_name: str, answer: Answer, *, stops: bool = False) -> Closable:
        """Serves a service; with ``stops``, each request is answered at once, on its own thread, without a queue."""
        ...

    def call(
        self, name: str, type_name: str, request: Mapping[str, Any], timeout_s: float, *, stops: bool = False
    ) -> Message:
        """Calls a ROS service; stops: regardless of the number of pending calls.

        Raises:
            RosUnreachable: it does not exist, or did not answer in time.
            RosRefused: it failed.
        """
        ...

    def act(self, name: str, type_name: str, do: Callable[[Goal], Outcome], refuse: Refuse | None = None) -> Closable:
        """Serves an action; each goal has its own thread, and a later one cancels the one before.

        Args:
            name: of the action.
            type_name: its type.
            do: carries out a goal to its end.
            refuse: decides about a goal without a wait. A goal that it refuses is rejected, and cancels none.
        """
        ...

    def pursue(
        self, name: str, type_name: str, goal: Mapping[str, Any], feedback: Callable[[Message], object] | None = None
    ) -> ActionGoal:
        """Sends a goal to a ROS action. Raises RosUnreachable: no node serves it."""
        ...

    def parameters(self, node: str, timeout_s: float) -> dict[str, Any]:
        """Returns the parameters of a node (ROS 1: a namespace) by name. Raises RosUnreachable, RosRefused."""
        ...

    def set_parameter(self, node: str, name: str, value: Any, timeout_s: float) -> None:
        """Sets a parameter. Raises RosUnreachable, RosRefused."""
        ...

    def watch_nodes(self, listener: NodeListener) -> Closable:
        """Reports nodes that come and go, the present ones first. A node that dies is reported within seconds."""
        ...

    @property
    def healthy(self) -> str:
        """Empty if the system is reachable, else why not: ``no master at http://...`` ."""
        ...

    def close(self) -> None:
        """Closes everything. Idempotent."""
        ...
