"""Services, topics and parameters of ROS as TRADE providers."""

import threading
import time
from collections.abc import Callable
from typing import Any, Final

from trade import Container, Resource, current_call, permit
from trade.errors import MotionStopped
from trade_gateway.ros._file import FromParameters, FromPublish, FromService, FromTopic
from trade_gateway.ros._graph import Graph, RosRefused, RosUnreachable
from trade_gateway.ros.from_ros._providers import Method, Records, plain, provider
from trade_gateway.ros_messages._types import Message

_STOPPED_WITHIN_S: Final = 2.0
_STOPS_OWED: Final = 10
_STOP_AGAIN_S: Final = 0.2
"""Stop messages after ROS is back, for as long as nodes take to reconnect."""


class OfferedProvider:
    """Something of ROS that is offered in TRADE."""

    def __init__(self, where: str, groups: list[str], provider: object, close: Callable[[], object]) -> None:
        self.where: Final = where
        """Its kind and name in ROS."""
        self.groups: Final = groups
        self.provider: Final = provider
        self._close = close

    def offer(self, container: Container) -> "OfferedProvider":
        """Registers it. Raises what `Container.register` does, and then leaves nothing behind."""
        try:
            container.register(self.provider, self.groups, meta={"ros": self.where})
        except BaseException:
            self._close()
            raise
        return self

    def withdraw(self, container: Container) -> None:
        """Stops its motion, then withdraws it."""
        container.deregister(self.provider)
        self._close()


def service_from_ros(entry: FromService, graph: Graph, records: Records) -> OfferedProvider:
    """``[[from_ros.service]]``. Raises ConfigurationError."""
    asked, answered = graph.types.parts(entry.type)
    parameters, optional = records.parameters(asked)
    returns = records.of(answered) if graph.types.fields(answered) else None
    name = entry.name or entry.service.rpartition("/")[2]
    doc = f"{entry.service} of ROS ({entry.type})."

    def call(args: dict[str, Any]) -> Any:
        return records.record(answered, graph.call(entry.service, entry.type, plain(args), _left_s(entry.deadline_s)))

    if entry.effect != "actuate":
        methods = [Method(name, doc, parameters, optional, returns, entry.effect, call)]
        return OfferedProvider(f"service {entry.service}", entry.groups, provider("RosService", methods), _nothing)
    motion = _Motion(entry, graph, Resource(f"{entry.groups[0]}.{name}"), call)
    methods = [
        Method(name, doc, parameters, optional, returns, "actuate", motion.begin, "stop"),
        Method("stop", f"{entry.stop} of ROS.", {}, frozenset(), None, "stop", motion.stop),
    ]
    made = provider("RosService", methods, [motion.resource])
    return OfferedProvider(f"service {entry.service}", entry.groups, made, _nothing)


class _Motion:
    """The motion of a ROS service, from its call until its response or that of the service that stops it."""

    def __init__(
        self, entry: FromService, graph: Graph, resource: Resource, call: Callable[[dict[str, Any]], Any]
    ) -> None:
        self.resource: Final = resource
        self._entry = entry
        self._graph = graph
        self._call = call
        self._guard = threading.Lock()
        self._stops = 0

    def begin(self, args: dict[str, Any]) -> Any:
        """Calls the service. A stop meanwhile may arrive there first, so it is then repeated."""
        with permit([self.resource]) as permitted:
            with self._guard:
                permitted.gate()
                before = self._stops
                self.resource.moving = True
            try:
                result = self._call(args)
            except RosUnreachable:  # the service may have begun
                self._tell_stop()
                raise
            except BaseException:
                self.resource.moving = False
                raise
            with self._guard:
                stopped = self._stops != before
            if stopped:
                self._tell_stop()
                raise MotionStopped(device=self.resource.name, reason="it was stopped")
            self.resource.moving = False
        return result

    def stop(self, _: dict[str, Any]) -> None:
        """Calls the service that stops."""
        with self._guard:
            self._stops += 1
        self._tell_stop()

    def _tell_stop(self) -> None:
        entry = self._entry
        response = self._graph.call(entry.stop, entry.stop_type, {}, _STOPPED_WITHIN_S, stops=True)
        if response.get("success") is False:
            raise RosRefused(what=entry.stop, problem=str(response.get("message", "")) or "it was not stopped")
        self.resource.moving = False


def topic_from_ros(entry: FromTopic, graph: Graph, records: Records) -> OfferedProvider:
    """``[[from_ros.topic]]``: a message that is too old is an error. Raises ConfigurationError."""
    kind = records.of(entry.type)
    latest: list[tuple[Message, float]] = []
    began = time.monotonic()

    def heard(message: Message, _who: str) -> None:
        latest[:] = [(message, time.monotonic())]

    def read(_: dict[str, Any]) -> Any:
        message, at = (latest or [({}, began)])[0]
        silent_s = time.monotonic() - at
        if not latest or (silent_s > entry.stale_after_s and not entry.latched):
            problem = f"no message for {silent_s:.3g} s. Is the node that publishes it running?"
            raise RosUnreachable(what=entry.topic, problem=problem)
        return records.record(entry.type, message)

    name = entry.name or entry.topic.rpartition("/")[2]
    age = "of any age" if entry.latched else f"at most {entry.stale_after_s:g} s old"
    doc = f"The latest message of {entry.topic} in ROS ({entry.type}), {age}."
    made = provider("RosTopic", [Method(name, doc, {}, frozenset(), kind, "read", read)])
    subscription = graph.subscribe(entry.topic, entry.type, heard, latched=entry.latched)
    return OfferedProvider(f"topic {entry.topic}", entry.groups, made, subscription.close)


def publisher_from_ros(entry: FromPublish, graph: Graph, records: Records) -> OfferedProvider:
    """``[[from_ros.publish]]``. Raises ConfigurationError."""
    parameters, optional = records.parameters(entry.type)
    graph.types.to_bytes(entry.type, entry.stop or {})  # raises now, not when the stop is needed
    name = entry.name or entry.topic.rpartition("/")[2]
    publisher = graph.advertise(entry.topic, entry.type)
    doc = f"Publish on {entry.topic} in ROS ({entry.type})."

    def send(args: dict[str, Any]) -> None:
        publisher.send(plain(args))

    if entry.stop is None:
        methods = [Method(name, doc, parameters, optional, None, "note", send)]
        return OfferedProvider(f"topic {entry.topic}", entry.groups, provider("RosPublisher", methods), publisher.close)
    setpoint = _SetPoint(Resource(f"{entry.groups[0]}.{name}"), publisher.send, entry, graph)
    holds = f" It holds for {entry.valid_s:g} s." if entry.valid_s else ""
    methods = [
        Method(name, doc + holds, parameters, optional, None, "actuate", setpoint.send, "stop"),
        Method("stop", f"Publish the stop message on {entry.topic}.", {}, frozenset(), None, "stop", setpoint.stop),
    ]
    made = provider("RosPublisher", methods, [setpoint.resource])

    def close() -> None:
        setpoint.close()
        publisher.close()

    return OfferedProvider(f"topic {entry.topic}", entry.groups, made, close)


class _SetPoint:
    """A published set-point that moves something, until its stop message.

    While ROS is lost, no node receives that message. It is then pending: published again and again until ROS has been
    back for some time. Until then the resource counts as moving.
    """

    def __init__(self, resource: Resource, send: Callable[[Message], object], entry: FromPublish, graph: Graph) -> None:
        self.resource: Final = resource
        self._send = send
        self._topic = entry.topic
        self._stop = entry.stop or {}
        self._valid_s = entry.valid_s
        self._graph = graph
        self._guard = threading.Lock()
        self._timer: threading.Timer | None = None
        self._owed = 0

    def send(self, args: dict[str, Any]) -> None:
        """Publishes a set-point, and the stop message when it expires without another one."""
        with permit([self.resource]) as permitted, self._guard:
            permitted.gate()
            self._still()
            self._owed = 0
            self.resource.moving = True
            self._send(plain(args))
            if self._valid_s:
                self._later(self._valid_s)

    def stop(self, _: dict[str, Any]) -> None:
        """Publishes the stop message. RosUnreachable: ROS is lost; the message is published as soon as it is back."""
        with self._guard:
            self._still()
            problem = self._halted()
        if problem:
            unpublished = f"{problem}; the stop message is published as soon as ROS is back"
            raise RosUnreachable(what=self._topic, problem=unpublished)

    def _over(self) -> None:
        with self._guard:
            if threading.current_thread() is self._timer:  # no other set-point followed
                self._timer = None
                self._halted()

    def _halted(self) -> str:
        """Publishes the stop message; returns ROS's problem if it may not have arrived. Call under the guard."""
        self._send(self._stop)
        problem = self._graph.healthy
        self._owed = _STOPS_OWED if problem else max(0, self._owed - 1)
        if self._owed:
            self._later(_STOP_AGAIN_S)
        else:
            self.resource.moving = False
        return problem

    def _later(self, after_s: float) -> None:
        self._timer = threading.Timer(after_s, self._over)
        self._timer.name, self._timer.daemon = "trade-ros-setpoint", True
        self._timer.start()

    def _still(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()

    def close(self) -> None:
        """Ends the timer."""
        with self._guard:
            self._still()


def parameters_from_ros(entry: FromParameters, graph: Graph) -> OfferedProvider:
    """``[[from_ros.parameters]]``. Raises ConfigurationError."""

    def read(_: dict[str, Any]) -> dict[str, Any]:
        return graph.parameters(entry.node, _left_s(entry.deadline_s))

    def write(args: dict[str, Any]) -> None:
        graph.set_parameter(entry.node, args["name"], args["value"], _left_s(entry.deadline_s))

    methods = [Method("parameters", f"Parameters of {entry.node}.", {}, frozenset(), dict[str, Any], "read", read)]
    if entry.set:
        kinds = {"name": str, "value": Any}
        doc = f"Set a parameter of {entry.node} in ROS."
        methods.append(Method("set_parameter", doc, kinds, frozenset(), None, "actuate", write))
    return OfferedProvider(f"parameters of {entry.node}", entry.groups, provider("RosParameters", methods), _nothing)


def _left_s(longest_s: float) -> float:
    """The time that the running call has left, at most `longest_s`, and always above 0."""
    call = current_call()
    return longest_s if call is None else max(0.01, call.patience_s(longest_s))


def _nothing() -> None:
    pass
