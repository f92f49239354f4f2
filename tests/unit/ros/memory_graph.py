"""A ROS system in memory: nodes with graphs of their own, real bytes between them, and deaths on command."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from trade_gateway.ros._graph import (
    Answer,
    Goal,
    GoalEnd,
    Heard,
    NodeListener,
    Outcome,
    Refuse,
    RosRefused,
    RosUnreachable,
)
from trade_gateway.ros_messages._types import Message, Types

PATIENCE_S = 60.0


class MemoryRos:
    """The system; `graph` gives a node's view of it."""

    def __init__(self, version: Literal[1, 2] = 2, folders: Iterable[Path] = ()) -> None:
        self.types = Types(version, folders)
        self.guard = threading.RLock()
        self.nodes: dict[str, MemoryGraph] = {}
        self.topics: dict[str, list[_Subscription]] = {}
        self.latched: dict[str, tuple[bytes, str]] = {}
        self.services: dict[str, _Service] = {}
        self.actions: dict[str, _Action] = {}
        self.parameters: dict[str, dict[str, Any]] = {}
        self.watchers: list[_Watch] = []
        self.problem = ""
        """Why no node can be seen any more; empty: the graph is healthy."""
        self.anonymous = False
        """Whether senders and callers are unknown."""

    def graph(self, node: str, *, seen: bool = True) -> "MemoryGraph":
        """A node; ``seen``: those who watch are notified of it."""
        made = MemoryGraph(self, node)
        with self.guard:
            self.nodes[node] = made
        if seen:
            self.tell(node, True)
        return made

    def kill(self, node: str) -> None:
        """It dies: all of it is gone at once, and those who watch hear of it."""
        self.nodes[node].close()

    def tell(self, node: str, there: bool) -> None:
        for watch in list(self.watchers):
            watch.listener(node, there)

    def who(self, node: str) -> str:
        return "" if self.anonymous else node

    def close(self) -> None:
        for graph in list(self.nodes.values()):
            graph.close()


class MemoryGraph:
    """One node's."""

    def __init__(self, ros: MemoryRos, node: str) -> None:
        self._ros = ros
        self.node = node
        self._open: list[Any] = []
        self.closed = False

    @property
    def types(self) -> Types:
        return self._ros.types

    @property
    def healthy(self) -> str:
        return self._ros.problem

    def _keep(self, made: Any) -> Any:
        self._open.append(made)
        return made

    def advertise(self, topic: str, type_name: str, *, latched: bool = False) -> "_Publisher":
        self.types.fields(type_name)
        return self._keep(_Publisher(self._ros, self, topic, type_name, latched))

    def subscribe(self, topic: str, type_name: str, heard: Heard, *, latched: bool = False) -> "_Subscription":
        return self._keep(_Subscription(self._ros, topic, type_name, heard, latched=latched))

    def serve(self, name: str, type_name: str, answer: Answer, *, stops: bool = False) -> "_Service":
        assert name not in self._ros.services, f"{name} is served twice"
        return self._keep(_Service(self._ros, name, type_name, answer, stops=stops))

    def call(
        self, name: str, type_name: str, request: Mapping[str, Any], timeout_s: float, *, stops: bool = False
    ) -> Message:
        found = self._ros.services.get(name)
        if found is None or self.closed:
            raise RosUnreachable(what=name, problem="no node serves it")
        return found.call(type_name, request, self._ros.who(self.node), timeout_s)

    def act(self, name: str, type_name: str, do: Callable[[Goal], Outcome], refuse: Refuse | None = None) -> "_Action":
        assert name not in self._ros.actions, f"{name} is served twice"
        return self._keep(_Action(self._ros, name, type_name, do, refuse))

    def pursue(
        self, name: str, type_name: str, goal: Mapping[str, Any], feedback: Callable[[Message], object] | None = None
    ) -> "_Pursuit":
        found = self._ros.actions.get(name)
        if found is None:
            raise RosUnreachable(what=name, problem="no node serves it")
        return found.begin(type_name, goal, self._ros.who(self.node), feedback)

    def parameters(self, node: str, timeout_s: float) -> dict[str, Any]:
        if node not in self._ros.parameters:
            raise RosUnreachable(what=node, problem="it is not there")
        return dict(self._ros.parameters[node])

    def set_parameter(self, node: str, name: str, value: Any, timeout_s: float) -> None:
        if name not in self.parameters(node, timeout_s):
            raise RosRefused(what=node, problem=f"it has no parameter {name}")
        self._ros.parameters[node][name] = value

    def watch_nodes(self, listener: NodeListener) -> "_Watch":
        made = self._keep(_Watch(self._ros, listener))
        for node in list(self._ros.nodes):
            listener(node, True)
        return made

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        with self._ros.guard:
            self._ros.nodes.pop(self.node, None)
        for one in reversed(self._open):
            one.close()
        self._ros.tell(self.node, False)


class _Watch:
    def __init__(self, ros: MemoryRos, listener: NodeListener) -> None:
        self._ros, self.listener = ros, listener
        ros.watchers.append(self)

    def close(self) -> None:
        if self in self._ros.watchers:
            self._ros.watchers.remove(self)


class _Publisher:
    def __init__(self, ros: MemoryRos, graph: MemoryGraph, topic: str, type_name: str, latched: bool) -> None:
        self._ros, self._graph, self.topic, self._type, self._latched = ros, graph, topic, type_name, latched
        self.closed = False

    def send(self, message: Mapping[str, Any]) -> None:
        data = self._ros.types.to_bytes(self._type, message)
        if self.closed:
            return
        who = self._ros.who(self._graph.node)
        with self._ros.guard:
            if self._latched:
                self._ros.latched[self.topic] = (data, who)
            for one in self._ros.topics.get(self.topic, []):
                one.waiting.put((data, who))

    def close(self) -> None:
        self.closed = True


class _Subscription:
    def __init__(self, ros: MemoryRos, topic: str, type_name: str, heard: Heard, *, latched: bool) -> None:
        self._ros, self.topic, self._type, self._heard = ros, topic, type_name, heard
        self.waiting: queue.SimpleQueue[tuple[bytes, str] | None] = queue.SimpleQueue()
        with ros.guard:
            ros.topics.setdefault(topic, []).append(self)
            if latched and topic in ros.latched:
                self.waiting.put(ros.latched[topic])
        self._thread = threading.Thread(target=self._run, name="memory-ros-topic", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while (one := self.waiting.get()) is not None:
            self._heard(self._ros.types.from_bytes(self._type, one[0]), one[1])

    def close(self) -> None:
        with self._ros.guard:
            if self in self._ros.topics[self.topic]:
                self._ros.topics[self.topic].remove(self)
        self.waiting.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(PATIENCE_S)


class _Service:
    def __init__(self, ros: MemoryRos, name: str, type_name: str, answer: Answer, *, stops: bool) -> None:
        self._ros, self.name, self._answer = ros, name, answer
        self._request, self._response = ros.types.parts(type_name)
        self._type = type_name
        self.asked = self.answered = 0
        self._turn = contextlib.nullcontext() if stops else threading.Lock()
        ros.services[name] = self

    def call(self, type_name: str, request: Mapping[str, Any], who: str, timeout_s: float) -> Message:
        assert type_name == self._type, f"{self.name} is {self._type}"
        types, asked = self._ros.types, self._ros.types.to_bytes(self._request, request)
        said: queue.SimpleQueue[Message | Exception] = queue.SimpleQueue()
        came_at = time.monotonic()
        self.asked += 1

        def run() -> None:
            try:
                with self._turn:
                    try:
                        reported = self._answer(types.from_bytes(self._request, asked), who, came_at)
                    finally:
                        self.answered += 1
                said.put(types.from_bytes(self._response, types.to_bytes(self._response, reported)))
            except Exception as error:  # noqa: BLE001 - it is sent to the caller
                said.put(error)

        threading.Thread(target=run, name="memory-ros-service", daemon=True).start()
        try:
            answered = said.get(timeout=timeout_s)
        except queue.Empty:
            raise RosUnreachable(what=self.name, problem=f"no answer within {timeout_s} s") from None
        if isinstance(answered, Exception):
            raise RosRefused(what=self.name, problem=str(answered))
        return answered

    def close(self) -> None:
        self._ros.services.pop(self.name, None)


class _Action:
    def __init__(
        self, ros: MemoryRos, name: str, type_name: str, do: Callable[[Goal], Outcome], refuse: Refuse | None
    ) -> None:
        self.ros, self.name, self.do, self._refuse = ros, name, do, refuse
        self.parts = ros.types.parts(type_name)
        self._type = type_name
        self._last: _Pursuit | None = None
        ros.actions[name] = self

    def begin(
        self, type_name: str, goal: Mapping[str, Any], who: str, feedback: Callable[[Message], object] | None
    ) -> "_Pursuit":
        assert type_name == self._type, f"{self.name} is {self._type}"
        types = self.ros.types
        message = types.from_bytes(self.parts[0], types.to_bytes(self.parts[0], goal))
        refused = None if self._refuse is None else self._refuse(message)
        if refused is not None:
            return _Pursuit(self, message, who, feedback).reject(refused)
        before, self._last = self._last, _Pursuit(self, message, who, feedback)
        if before is not None:
            before.cancel()
        return self._last.begin()

    def close(self) -> None:
        self.ros.actions.pop(self.name, None)
        if self._last is not None:
            self._last.cancel()


class _Pursuit:
    """Both sides of a goal."""

    def __init__(
        self, action: _Action, message: Message, client: str, feedback: Callable[[Message], object] | None
    ) -> None:
        self._action, self.message, self.client, self._feedback = action, message, client, feedback
        self._callbacks: list[Callable[[], object]] = []
        self._ended: queue.SimpleQueue[Outcome | Exception] = queue.SimpleQueue()
        self._guard = threading.Lock()
        self.canceled = False
        self.came_at = time.monotonic()

    def reject(self, why: Outcome) -> "_Pursuit":
        self._ended.put(RosRefused(what=self._action.name, problem=why.text))
        return self

    def begin(self) -> "_Pursuit":
        threading.Thread(target=self._run, name="memory-ros-goal", daemon=True).start()
        return self

    def _run(self) -> None:
        types, result = self._action.ros.types, self._action.parts[1]
        try:
            outcome = self._action.do(self)
            reported = types.from_bytes(result, types.to_bytes(result, outcome.result))
            self._ended.put(Outcome(outcome.how, reported, outcome.text))
        except Exception as error:  # noqa: BLE001 - it is sent to the caller
            self._ended.put(Outcome(GoalEnd.ABORTED, types.zero(result), str(error)))

    def feedback(self, message: Mapping[str, Any]) -> None:
        types, part = self._action.ros.types, self._action.parts[2]
        reported = types.from_bytes(part, types.to_bytes(part, message))
        if self._feedback is not None:
            self._feedback(reported)

    def when_canceled(self, tell: Callable[[], object]) -> None:
        with self._guard:
            self._callbacks.append(tell)
            now = self.canceled
        if now:
            tell()

    def wait(self, timeout_s: float) -> Outcome:
        try:
            ended = self._ended.get(timeout=timeout_s)
        except queue.Empty:
            raise RosUnreachable(what=self._action.name, problem=f"no end within {timeout_s} s") from None
        if isinstance(ended, Exception):
            raise ended
        self._ended.put(ended)
        return ended

    def cancel(self) -> None:
        with self._guard:
            if self.canceled:
                return
            self.canceled = True
            callbacks = list(self._callbacks)
        for tell in callbacks:
            threading.Thread(target=tell, name="memory-ros-cancel", daemon=True).start()
