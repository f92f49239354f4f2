"""Results of TRADE services as ROS topics."""

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from trade import Constraint, Container, Handle, Sample, Stream, where
from trade_gateway.ros._file import JointStates, RobotEntry, StreamEntry
from trade_gateway.ros._graph import Closable, Graph, Publisher
from trade_gateway.ros._joints import LIMBS, JointMeasurement, joints_of, limbs, measured
from trade_gateway.ros._mapping_sync import Place, absent_name, named_services, of_name
from trade_gateway.ros_messages._conversion import ResponseMapping, failure, ros_stamp
from trade_gateway.ros_messages._joint_names import JointNames
from trade_gateway.ros_messages._types import Message

_logger = logging.getLogger("trade")

_LOOK_EVERY_S: Final = 0.5
_JOINT_STATE: Final = "sensor_msgs/msg/JointState"
_HEALTHY: Final = "healthy"


class Topics:
    """Published topics, each opened once for all entries that use it."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._guard = threading.Lock()
        self._shared: dict[tuple[str, str], tuple[Publisher, int]] = {}

    def take(self, topic: str, type_name: str) -> Publisher:
        """Publishes a topic from now on. Raises what `Graph.advertise` does."""
        with self._guard:
            shared = self._shared.get((topic, type_name))
            publisher, users = shared or (self._graph.advertise(topic, type_name), 0)
            self._shared[topic, type_name] = (publisher, users + 1)
            return publisher

    def leave(self, topic: str, type_name: str) -> None:
        """Removes one user of a topic; the last one closes it."""
        with self._guard:
            publisher, users = self._shared.pop((topic, type_name))
            if users > 1:
                self._shared[topic, type_name] = (publisher, users - 1)
                return
        publisher.close()


class StreamsToRos:
    """``[[to_ros.stream]]``."""

    def __init__(self, entry: StreamEntry, topics: Topics, graph: Graph, container: Container) -> None:
        """Raises ConfigurationError: the type is not known, or has no such fields."""
        self._entry = entry
        self._topics = topics
        self._container = container
        self._response = ResponseMapping(graph.types, entry.type, entry.fields)

    @property
    def of(self) -> Constraint:
        return of_name(self._entry.service)

    @property
    def absent(self) -> tuple[str, str]:
        return absent_name(self._entry.service, f"topic {self._entry.topic}")

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        for handle in named_services(self._entry.service, found):
            yield Place("topic", self._entry.topic), handle

    def open(self, place: Place, handle: Handle) -> Closable:
        entry, response = self._entry, self._response
        stream = self._container.stream(handle, hz=entry.hz)
        return _Pump(stream, self._topics, place.name, entry.type, lambda sample: response(sample.value, sample.at))


class LimbTopic(ABC):
    """A topic about measured joints and grippers: old, missing or unhealthy values are not published.

    Args:
        entry: the joints, their names and the rate.
        topic: its name.
        type_name: its type.
        topics: those of the bridge.
        container: its container.
    """

    def __init__(
        self, entry: JointStates | RobotEntry, topic: str, type_name: str, topics: Topics, container: Container
    ) -> None:
        self._entry = entry
        self._topic = topic
        self._type_name = type_name
        self._topics = topics
        self._container = container

    @property
    def of(self) -> Constraint:
        return where(group=self._entry.group, name="state") & LIMBS

    @property
    def absent(self) -> tuple[str, str]:
        return self._entry.group, f"no joints, arm or gripper for topic {self._topic}"

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        for handle in limbs(found, self._entry.group, "state"):
            yield Place("topic", self._topic), handle

    def open(self, place: Place, handle: Handle) -> Closable:
        entry, joints = self._entry, joints_of(self._container, handle)
        named = {ros_name: own for ros_name, own in entry.joints.items() if own in joints}
        names = JointNames(joints, short=entry.names == "last", named=named)
        ros_names = {own: name for name, own in names.trade_names.items()}

        def message(sample: Sample) -> Message | None:
            if handle.health != _HEALTHY:
                return None
            now = measured(joints, sample.value)
            return self._message([ros_names[own] for own in now.names], now, sample.at - now.age_s)

        stream = self._container.stream(handle, hz=entry.hz)
        return _Pump(stream, self._topics, place.name, self._type_name, message)

    @abstractmethod
    def _message(self, names: Sequence[str], now: JointMeasurement, at_s: float) -> Message:
        """The message for measurements of joints with these names in ROS, made at a time in seconds since the epoch."""


class JointStatesToRos(LimbTopic):
    """``[[to_ros.joint_states]]``."""

    def __init__(self, entry: JointStates, topics: Topics, container: Container) -> None:
        super().__init__(entry, entry.topic, _JOINT_STATE, topics, container)

    def _message(self, names: Sequence[str], now: JointMeasurement, at_s: float) -> Message:
        return {
            "header": {"stamp": ros_stamp(at_s)},
            "name": list(names),
            "position": list(now.positions),
            "velocity": list(now.velocities),
        }


class _Pump:
    """Publishes the samples of a stream; drops what cannot be read, and logs that once."""

    def __init__(
        self,
        stream: Stream,
        topics: Topics,
        topic: str,
        type_name: str,
        message: Callable[[Sample], Message | None],
    ) -> None:
        self._stream = stream
        self._topics = topics
        self._place = (topic, type_name)
        self._message = message
        self._problem = ""
        self._closing = False
        try:
            self._publisher = topics.take(topic, type_name)
        except BaseException:
            stream.close()
            raise
        self._thread = threading.Thread(target=self._run, name="trade-ros-stream", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not (self._closing or self._stream.ended):
            try:
                message = self._message(self._stream.next(_LOOK_EVERY_S))
                if message is not None:
                    self._publisher.send(message)
                self._problem = ""
            except Exception as error:  # noqa: BLE001 - an error of a service must not end the topic
                self._note(error)

    def _note(self, error: Exception) -> None:
        if self._closing or type(error) is TimeoutError:  # no sample for a moment
            return
        if type(error).__name__ != self._problem:  # its text has times in it
            _logger.warning("nothing is published on %s: %s", self._place[0], failure(error))
        self._problem = type(error).__name__

    def close(self) -> None:
        self._closing = True
        self._stream.close()
        self._thread.join()
        self._topics.leave(*self._place)
