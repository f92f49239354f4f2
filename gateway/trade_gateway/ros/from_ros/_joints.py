"""Joints of ROS, which a topic reports and an action moves, as a TRADE provider."""

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

import msgspec
from msgspec import Struct

from trade import Meta, Resource, current_call, service
from trade.errors import InvalidArgument
from trade.protocol.schema_types import publish
from trade_drivers import Trajectory
from trade_gateway.ros._file import FromJoints
from trade_gateway.ros._goals import ACTION, goal_of
from trade_gateway.ros._graph import Graph, RosUnreachable
from trade_gateway.ros.from_ros._sent_goals import SentGoals
from trade_gateway.ros.from_ros._services import OfferedProvider
from trade_gateway.ros_messages._types import Message

_JOINT_STATE: Final = "sensor_msgs/msg/JointState"
_PEAK: Final = 1.5
"""Ratio of the peak to the mean speed of a cubic curve from rest to rest."""
_SHORTEST_S: Final = 0.2
_REST_RAD_S: Final = 1e-3
"""A last velocity up to this is rest, as in `trade_drivers`."""

Position = Annotated[float, Meta(description="joint angle in rad")]


class RosJoint(Struct, frozen=True, kw_only=True):
    """The last received state of one joint."""

    name: str
    """Ours: ``lab.arm.shoulder``."""
    position_rad: float
    velocity_rad_s: float | None
    """None: the topic does not include it."""
    effort_nm: float | None
    age_s: float
    """The age of this state in seconds."""


publish("trade_gateway.ros", RosJoint)


class RosJoints:
    """Joints of ROS; values are in the order of ``joints()``. Only ROS knows their limits."""

    def __init__(self, entry: FromJoints, graph: Graph) -> None:
        self._entry = entry
        self._names = [f"{entry.groups[0]}.{name}" for name in entry.joints]
        self.resources: Final = tuple(Resource(name) for name in self._names)
        self._latest: dict[str, tuple[float, float | None, float | None, float]] = {}
        self._began = time.monotonic()
        self._news = threading.Condition()
        """Notified of each message."""
        self._goals = SentGoals(graph, entry.action, ACTION, entry.groups[0], self.resources)
        self._subscription = graph.subscribe(entry.topic, _JOINT_STATE, self._hear)

    def _hear(self, message: Message, _who: str) -> None:
        now = time.monotonic()
        for number, name in enumerate(message["name"][: len(message["position"])]):
            values = [_nth(message[field], number) for field in ("velocity", "effort")]
            self._latest[name] = (message["position"][number], values[0], values[1], now)
        with self._news:
            self._news.notify_all()

    @service(effect="read")
    def joints(self) -> list[str]:
        """The names of the joints, in the order of all values."""
        return list(self._names)

    @service(effect="read")
    def state(self) -> list[RosJoint]:
        """The last state of every joint; RosUnreachable if one is too old."""
        now, joints = time.monotonic(), list[RosJoint]()
        for ros_name, own in zip(self._entry.joints, self._names, strict=True):
            position, velocity, effort, at = self._latest.get(ros_name, (0.0, None, None, None))
            silent_s = now - (self._began if at is None else at)
            if at is None or silent_s > self._entry.stale_after_s:
                problem = f"no state of {ros_name} for {silent_s:.3g} s. Is the node that publishes it running?"
                raise RosUnreachable(what=self._entry.topic, problem=problem)
            joints.append(
                RosJoint(name=own, position_rad=position, velocity_rad_s=velocity, effort_nm=effort, age_s=silent_s)
            )
        return joints

    @service(cancel="stop")
    def move_to(self, positions_rad: list[Position], speed_rad_s: float | None = None) -> list[float]:
        """Move all joints to angles, arriving together; return the angles after the end.

        Raises:
            InvalidArgument: the number of angles is wrong, or the speed is invalid.
            RosUnreachable: the angles are unknown, or no node serves the action, or the joints have arrived, but no
                state was received since.
            RosRefused: the goal was rejected.
            DeviceFault: the goal was aborted, or whether it has ended is unknown.
            MotionStopped: it was stopped, or the call's deadline expired first.
        """
        if len(positions_rad) != len(self._names):
            problem = f"{len(positions_rad)} for {len(self._names)} joints"
            raise InvalidArgument(service="move_to", argument="positions_rad", problem=problem)
        fastest = self._entry.max_speed_rad_s
        speed = fastest if speed_rad_s is None else speed_rad_s
        if not 0 < speed <= fastest:
            problem = f"{speed:g} is not above 0 and at most {fastest:g}"
            raise InvalidArgument(service="move_to", argument="speed_rad_s", problem=problem)
        way = max(abs(to - one.position_rad) for to, one in zip(positions_rad, self.state(), strict=True))
        still = [0.0] * len(self._names)
        at_s = max(_SHORTEST_S, _PEAK * way / speed)
        return self._pursue([{"time_from_start_s": at_s, "positions_rad": positions_rad, "velocities_rad_s": still}])

    @service(cancel="stop")
    def follow(self, trajectory: Trajectory) -> list[float]:
        """Go through angles at given times; return the angles after it. ROS enforces limits. Raises like move_to.

        Args:
            trajectory: of all joints, in any order.
        """
        if sorted(trajectory.joints) != sorted(self._names):
            problem = f"is for {', '.join(trajectory.joints) or 'no joints'}; it takes one for {', '.join(self._names)}"
            raise InvalidArgument(service="follow", argument="trajectory.joints", problem=problem)
        order = [trajectory.joints.index(name) for name in self._names]
        points: list[Message] = []
        for point in trajectory.points:
            plain: Message = msgspec.to_builtins(point)
            for field in ("positions_rad", "velocities_rad_s", "accelerations_rad_s2"):
                if (values := getattr(point, field)) is not None:
                    if len(values) != len(order):
                        problem = f"a point has {len(values)} values for {len(order)} joints"
                        raise InvalidArgument(service="follow", argument="trajectory.points", problem=problem)
                    plain[field] = [values[column] for column in order]
            points.append(plain)
        for last in points[-1:]:
            if (speeds := last["velocities_rad_s"]) is not None:
                last["velocities_rad_s"] = self._at_rest(speeds)
        return self._pursue(points)

    def _at_rest(self, speeds_rad_s: Sequence[float]) -> list[float]:
        """Returns 0 for each last speed that no joint resolves, as a ROS controller refuses even 1e-6 rad/s."""
        for name, speed in zip(self._names, speeds_rad_s, strict=True):
            if not abs(speed) <= _REST_RAD_S:
                problem = f"{name} still has {speed:g} rad/s at the last point; a trajectory must end at rest (0)"
                raise InvalidArgument(service="follow", argument="trajectory.velocities_rad_s", problem=problem)
        return [0.0] * len(speeds_rad_s)

    @service(effect="stop")
    def stop(self) -> None:
        """Cancel the goals that this bridge sent to the action; DeviceFault if their end is not confirmed.

        Goals of other ROS nodes continue.
        """
        self._goals.stop()

    def _pursue(self, points: Sequence[Mapping[str, Any]]) -> list[float]:
        outcome = self._goals.carry_out(goal_of(self._entry.joints, points), lambda feedback: feedback)
        if outcome.result.get("error_code", 0):
            raise self._goals.fault(outcome)
        self._await_news(time.monotonic())
        return [one.position_rad for one in self.state()]

    def _await_news(self, ended_at: float) -> None:
        """Waits for states after the end, as earlier ones were on the way. Raises RosUnreachable: there were none."""
        call, longest_s = current_call(), self._entry.stale_after_s
        wait_s = longest_s if call is None else call.patience_s(longest_s)
        with self._news:
            if self._news.wait_for(lambda: not self._unheard(ended_at), wait_s):
                return
        silent = ", ".join(self._unheard(ended_at))
        problem = f"the motion has ended, but for {wait_s:.3g} s no state of {silent} arrived: its angle is unknown"
        raise RosUnreachable(what=self._entry.topic, problem=problem)

    def _unheard(self, since: float) -> list[str]:
        """Joints without a state since then."""
        return [name for name in self._entry.joints if name not in self._latest or self._latest[name][3] <= since]

    def close(self) -> None:
        """Ends the subscription."""
        self._subscription.close()


def _nth(values: Sequence[float], number: int) -> float | None:
    return values[number] if number < len(values) else None


def joints_from_ros(entry: FromJoints, graph: Graph) -> OfferedProvider:
    """``[[from_ros.joints]]``. Raises ConfigurationError."""
    made = RosJoints(entry, graph)
    return OfferedProvider(f"action {entry.action}", entry.groups, made, made.close)
