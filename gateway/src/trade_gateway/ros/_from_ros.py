"""Services, topics and parameters of ROS as providers of ours."""

import threading
import time
from collections.abc import Callable
from typing import Any, Final

from trade import Container, Resource, current_call, permit
from trade_gateway.ros._file import FromParameters, FromPublish, FromService, FromTopic
from trade_gateway.ros._graph import Graph, RosRefused, RosUnreachable
from trade_gateway.ros._offering import Method, Records, plain, provider
from trade_gateway.ros._types import Message

__all__ = ["Offered", "parameters_from_ros", "publisher_from_ros", "service_from_ros", "topic_from_ros"]

_STOPPED_WITHIN_S: Final = 2.0


class Offered:
    """Something of theirs that is offered here."""

    def __init__(self, where: str, groups: list[str], provider: object, close: Callable[[], object]) -> None:
        self.where: Final = where
        """What it is in ROS."""
        self.groups: Final = groups
        self.provider: Final = provider
        self._close = close

    def offer(self, container: Container) -> "Offered":
        """Register it. Raises what `Container.register` does; then nothing of it is left."""
        try:
            container.register(self.provider, self.groups, meta={"ros": self.where})
        except BaseException:
            self._close()
            raise
        return self

    def withdraw(self, container: Container) -> None:
        """What it moves stops first."""
        container.deregister(self.provider)
        self._close()


def service_from_ros(entry: FromService, graph: Graph, records: Records) -> Offered:
    """``[[from_ros.service]]``. Raises ConfigurationError."""
    asked, answered = graph.types.parts(entry.type)
    parameters, optional = records.parameters(asked)
    returns = records.of(answered) if graph.types.fields(answered) else None
    name = entry.name or entry.service.rpartition("/")[2]
    resources = [Resource(f"{entry.groups[0]}.{name}")] if entry.effect == "actuate" else []

    def call(args: dict[str, Any]) -> Any:
        return records.record(answered, graph.call(entry.service, entry.type, plain(args), _left_s(entry.deadline_s)))

    def actuate(args: dict[str, Any]) -> Any:
        [resource] = resources
        with permit(resources) as permitted:
            permitted.gate()
            resource.moving = True
            try:
                result = call(args)
            except RosUnreachable:  # it may have begun all the same
                stop({})
                raise
            except BaseException:
                resource.moving = False
                raise
            resource.moving = False
        return result

    def stop(_: dict[str, Any]) -> None:
        told = graph.call(entry.stop, entry.stop_type, {}, _STOPPED_WITHIN_S)
        if told.get("success") is False:
            raise RosRefused(what=entry.stop, problem=str(told.get("message", "")) or "it was not stopped")
        for resource in resources:
            resource.moving = False

    doc = f"{entry.service} of ROS ({entry.type})."
    does = actuate if resources else call
    cancel = "stop" if resources else None
    methods = [Method(name, doc, parameters, optional, returns, entry.effect, does, cancel)]
    if resources:
        methods.append(Method("stop", f"{entry.stop} of ROS.", {}, frozenset(), None, "stop", stop))
    return Offered(f"service {entry.service}", entry.groups, provider("RosService", methods, resources), _nothing)


def topic_from_ros(entry: FromTopic, graph: Graph, records: Records) -> Offered:
    """``[[from_ros.topic]]``: what is older than it may be is an error. Raises ConfigurationError."""
    kind = records.of(entry.type)
    latest: list[tuple[Message, float]] = []
    began = time.monotonic()

    def heard(message: Message, _who: str) -> None:
        latest[:] = [(message, time.monotonic())]

    def read(_: dict[str, Any]) -> Any:
        message, at = (latest or [({}, began)])[0]
        silent_s = time.monotonic() - at
        if not latest or (silent_s > entry.stale_after_s and not entry.latched):
            problem = f"nothing was heard for {silent_s:.3g} s; is the node up that publishes it?"
            raise RosUnreachable(what=entry.topic, problem=problem)
        return records.record(entry.type, message)

    name = entry.name or entry.topic.rpartition("/")[2]
    age = "however old" if entry.latched else f"{entry.stale_after_s:g} s old at most"
    doc = f"The latest message of {entry.topic} in ROS ({entry.type}), {age}."
    made = provider("RosTopic", [Method(name, doc, {}, frozenset(), kind, "read", read)])
    subscription = graph.subscribe(entry.topic, entry.type, heard, latched=entry.latched)
    return Offered(f"topic {entry.topic}", entry.groups, made, subscription.close)


def publisher_from_ros(entry: FromPublish, graph: Graph, records: Records) -> Offered:
    """``[[from_ros.publish]]``. Raises ConfigurationError."""
    parameters, optional = records.parameters(entry.type)
    graph.types.to_bytes(entry.type, entry.stop or {})  # wrong is wrong before it is needed
    name = entry.name or entry.topic.rpartition("/")[2]
    publisher = graph.advertise(entry.topic, entry.type)
    doc = f"Publish on {entry.topic} in ROS ({entry.type})."

    def send(args: dict[str, Any]) -> None:
        publisher.send(plain(args))

    if entry.stop is None:
        methods = [Method(name, doc, parameters, optional, None, "note", send)]
        return Offered(f"topic {entry.topic}", entry.groups, provider("RosPublisher", methods), publisher.close)
    setpoint = _SetPoint(Resource(f"{entry.groups[0]}.{name}"), publisher.send, entry.stop, entry.valid_s)
    holds = f" It holds for {entry.valid_s:g} s." if entry.valid_s else ""
    methods = [
        Method(name, doc + holds, parameters, optional, None, "actuate", setpoint.send, "stop"),
        Method("stop", f"Publish on {entry.topic} what stops.", {}, frozenset(), None, "stop", setpoint.stop),
    ]
    made = provider("RosPublisher", methods, [setpoint.resource])

    def close() -> None:
        setpoint.close()
        publisher.close()

    return Offered(f"topic {entry.topic}", entry.groups, made, close)


class _SetPoint:
    """What is published and moves something, until the message that stops it."""

    def __init__(self, resource: Resource, send: Callable[[Message], object], stop: Message, valid_s: float) -> None:
        self.resource: Final = resource
        self._send = send
        self._stop = stop
        self._valid_s = valid_s
        self._guard = threading.Lock()
        self._timer: threading.Timer | None = None

    def send(self, args: dict[str, Any]) -> None:
        """Publish it, and what stops when its time is over, unless another one comes before."""
        with permit([self.resource]) as permitted, self._guard:
            permitted.gate()
            self._still()
            self.resource.moving = True
            self._send(plain(args))
            if self._valid_s:
                self._timer = threading.Timer(self._valid_s, self._over)
                self._timer.name, self._timer.daemon = "trade-ros-setpoint", True
                self._timer.start()

    def stop(self, _: dict[str, Any]) -> None:
        """Publish what stops."""
        with self._guard:
            self._still()
            self._send(self._stop)
            self.resource.moving = False

    def _over(self) -> None:
        with self._guard:
            if threading.current_thread() is self._timer:  # no other came meanwhile
                self._timer = None
                self._send(self._stop)
                self.resource.moving = False

    def _still(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()

    def close(self) -> None:
        """Nothing is published any more."""
        with self._guard:
            self._still()


def parameters_from_ros(entry: FromParameters, graph: Graph) -> Offered:
    """``[[from_ros.parameters]]``. Raises ConfigurationError."""

    def read(_: dict[str, Any]) -> dict[str, Any]:
        return graph.parameters(entry.node, _left_s(entry.deadline_s))

    def write(args: dict[str, Any]) -> None:
        graph.set_parameter(entry.node, args["name"], args["value"], _left_s(entry.deadline_s))

    methods = [Method("parameters", f"Those of {entry.node} in ROS.", {}, frozenset(), dict[str, Any], "read", read)]
    if entry.set:
        kinds = {"name": str, "value": Any}
        doc = f"Set a parameter of {entry.node} in ROS."
        methods.append(Method("set_parameter", doc, kinds, frozenset(), None, "actuate", write))
    return Offered(f"parameters of {entry.node}", entry.groups, provider("RosParameters", methods), _nothing)


def _left_s(longest_s: float) -> float:
    """What the running call has left, at most so much; never nothing, as its end is the caller's to see."""
    call = current_call()
    left_s = None if call is None else call.remaining_s
    return longest_s if left_s is None else max(0.01, min(longest_s, left_s))


def _nothing() -> None:
    pass
