"""The subscriptions of a recording: joints, arms, grippers, cameras and other services, as they come and go."""

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple, cast

from msgspec.structs import replace

from trade import Container, Handle, Sample, Stream, where
from trade.errors import ServiceGone, TradeError
from trade_gateway.recording._channels import (
    FAULTS,
    Fault,
    FaultKind,
    JointStates,
    Message,
    encoded,
    joints_channel,
    picture,
    service_channel,
)
from trade_gateway.recording._timeline import Timeline

_KEEP: Final = 500
"""Most samples of a stream that wait for a slow disk."""
_LIMITS_S: Final = 2.0

Read = Callable[[Handle, Sample], Message]


class RecordedParts(NamedTuple):
    """The parts of a system to record."""

    groups: Sequence[str] = ()
    """These groups and those beneath them; none: all."""
    services: Sequence[str] = ()
    """Other services that only read, by group and name; ``*`` and ``?`` are wildcards."""
    joints_hz: float = 50.0
    cameras_hz: float = 5.0
    services_hz: float = 10.0


class _Source(NamedTuple):
    stream: Stream
    read: Read


class Sources:
    """The open streams. Used by one thread, which is woken when there are samples."""

    def __init__(self, container: Container, wanted: RecordedParts, wake: threading.Event, timeline: Timeline) -> None:
        self._container = container
        self._timeline = timeline
        self._parts = wanted
        self._wake = wake
        self._open: dict[Handle, _Source] = {}
        self._arms: dict[Handle, list[str]] = {}
        """The names of arms' joints."""
        self._wrong: dict[tuple[str, FaultKind], str] = {}
        """The last fault of each service and joint; empty: it is healthy."""
        self._refused: list[Message] = []
        self.dropped = 0
        """Number of samples lost on the way, or because of a slow disk."""

    def look(self) -> None:
        """Subscribes to new services, and ends the streams of lost ones."""
        present: set[Handle] = set()
        for handle, hz, read in self._meant():
            present.add(handle)
            if handle not in self._open:
                self._listen(handle, hz, read)
        for gone in [handle for handle in self._open if handle not in present]:
            self._open.pop(gone).stream.close()

    def _listen(self, handle: Handle, hz: float, read: Read) -> None:
        try:
            stream = self._container.stream(handle, hz=hz, keep=_KEEP)
        except TradeError as bad:  # it has shut down, or may not be read; retried at the next look
            text = f"{type(bad).__name__}: {bad}"
            self._refused.extend(self._noted(handle.label, "unreadable", text, type(bad).__name__))
            return
        stream.on_sample(self._wake.set)
        self._open[handle] = _Source(stream, read)
        self._wake.set()

    def _meant(self) -> Iterator[tuple[Handle, float, Read]]:
        wanted = self._parts
        readable = [
            handle
            for handle in self._container.services(~where(group="trade"))
            if handle.effect == "read" and within(handle.label, wanted.groups)
        ]
        grouped = {name for handle in self._container.services(where(kind="JointGroup")) for name in handle.resources}
        for handle in readable:
            if handle.name == "state" and _moves(handle, grouped):
                yield handle, wanted.joints_hz, self._arm if "Arm" in handle.kinds else _joints
            elif handle.name == "image" and "Camera" in handle.kinds:
                yield handle, wanted.cameras_hz, _image
            elif any(fnmatchcase(handle.label, pattern) for pattern in wanted.services):
                yield handle, wanted.services_hz, _answer

    def take(self) -> Iterator[Message]:
        """Yields the messages since the last time, without their time of arrival."""
        refused, self._refused = self._refused, []
        yield from refused
        for source in list(self._open.values()):
            yield from self._taken(source)

    def _taken(self, source: _Source) -> Iterator[Message]:
        handle = source.stream.source
        while True:
            try:
                sample = source.stream.take()
                message = None if sample is None else source.read(handle, self._placed(handle, sample))
            except ServiceGone:  # the registry reports that too
                return
            except Exception as bad:  # noqa: BLE001 - any exception of the service itself
                yield from self._noted(handle.label, "unreadable", f"{type(bad).__name__}: {bad}", type(bad).__name__)
                if bad is source.stream.why_ended:
                    return
                continue
            if sample is None or message is None:
                return
            self.dropped += sample.dropped
            yield from self._noted(handle.label, "unreadable", "")
            if source.read is not _image and source.read is not _answer:
                for joint, fault in _faults(sample.value):
                    yield from self._noted(joint, "joint", fault)
            yield message

    def _placed(self, handle: Handle, sample: Sample) -> Sample:
        """The sample, at its time on the recording's timeline."""
        return replace(sample, at=self._timeline.placed(handle.container, sample.at, sample.at_ns))

    def _noted(self, about: str, kind: FaultKind, text: str, what: str = "") -> Iterator[Message]:
        """Yields a message if a fault has changed; compares ``what``, because the whole text may contain times."""
        now, before = what or text, self._wrong.get((about, kind))
        self._wrong[about, kind] = now
        if now != (before or ""):
            fault = Fault(about=about, kind=kind, text=text, new=before is not None)
            yield Message(FAULTS, 0, self._timeline.now_ns(), encoded(fault))

    def _arm(self, handle: Handle, sample: Sample) -> Message:
        names = self._arms.get(handle)
        if names is None:
            service = where(name="limits", group=handle.groups[0], container=handle.container, kind="Arm")
            limits = self._container.find(service, wait_s=0).with_(deadline_s=_LIMITS_S)()
            names = self._arms[handle] = [joint.name for joint in limits.joints]
        return _joints(handle, sample, names)

    def labels(self) -> list[str]:
        """Labels of the subscribed services."""
        return sorted(source.stream.source.label for source in self._open.values())

    def close(self) -> None:
        """Ends all streams. Idempotent."""
        for source in self._open.values():
            source.stream.close()
        self._open.clear()


def within(label: str, groups: Iterable[str]) -> bool:
    """Whether a service, by its group and name, belongs to one of these groups; True if there are no groups."""
    asked = list(groups)
    return not asked or any(label == group or label.startswith(f"{group}.") for group in asked)


def _moves(handle: Handle, grouped: set[str]) -> bool:
    """Whether a state is of joints, or of a gripper, that no other state includes."""
    kinds = handle.kinds
    return bool({"JointGroup", "Arm", "Gripper", "RosJoints"} & set(kinds)) or (
        "Motor" in kinds and handle.groups[0] not in grouped
    )


def _ns(at_s: float) -> int:
    return int(at_s * 1e9)


def _faults(value: Any) -> list[tuple[str, str]]:
    """Joints, arms or grippers, and the faults of each."""
    states: list[Any] = cast("list[Any]", value) if isinstance(value, list) else [value]
    return [(state.name, state.fault) for state in states if hasattr(state, "fault")]


def joint_states(value: Any, at_s: float, arm_joints: list[str] | None = None) -> JointStates:
    """Converts the state of a motor, of a group of joints, of an arm or of a gripper.

    Args:
        value: the result of its ``state``.
        at_s: its time, in seconds since the epoch.
        arm_joints: the names of an arm's joints; None: it is not an arm.
    """
    if arm_joints is not None:
        return _arm_states(value, at_s, arm_joints)
    if hasattr(value, "width_m"):
        return _gripper_states(value, at_s)
    motors: list[Any] = cast("list[Any]", value) if isinstance(value, list) else [value]
    if any(hasattr(motor, "effort_nm") for motor in motors):
        return _ros_states(motors, at_s)
    return JointStates(
        names=[motor.name for motor in motors],
        position_rad=[motor.position_rad for motor in motors],
        velocity_rad_s=[motor.velocity_rad_s for motor in motors],
        load=[motor.load for motor in motors],
        enabled=[motor.enabled for motor in motors],
        fault=[motor.fault for motor in motors],
        stamp_s=[at_s - motor.age_s for motor in motors],
    )


def _arm_states(arm: Any, at_s: float, names: list[str]) -> JointStates:
    return JointStates(
        names=names,
        position_rad=arm.positions_rad,
        velocity_rad_s=arm.velocities_rad_s,
        load=[],
        enabled=[arm.enabled] * len(names),
        fault=[arm.fault] * len(names),
        stamp_s=[at_s - arm.age_s] * len(names),
    )


def _ros_states(joints: list[Any], at_s: float) -> JointStates:
    """Joints of ROS, which knows neither loads nor faults, and perhaps no speeds."""
    speeds = [joint.velocity_rad_s for joint in joints]
    return JointStates(
        names=[joint.name for joint in joints],
        position_rad=[joint.position_rad for joint in joints],
        velocity_rad_s=[] if None in speeds else speeds,
        load=[],
        enabled=[],
        fault=[],
        stamp_s=[at_s - joint.age_s for joint in joints],
    )


def _gripper_states(gripper: Any, at_s: float) -> JointStates:
    return JointStates(
        names=[gripper.name],
        position_rad=[],
        velocity_rad_s=[],
        width_m=[gripper.width_m],
        speed_m_s=[gripper.speed_m_s],
        load=[],
        enabled=[gripper.activated],
        fault=[gripper.fault],
        stamp_s=[at_s - gripper.age_s],
    )


def _joints(handle: Handle, sample: Sample, arm_joints: list[str] | None = None) -> Message:
    states = joint_states(sample.value, sample.at, arm_joints)
    return Message(joints_channel(handle.groups[0]), 0, _ns(min(states.stamp_s)), encoded(states))


def _image(handle: Handle, sample: Sample) -> Message:
    image: Any = sample.value
    at_ns = _ns(sample.at - image.age_s)
    return picture(handle.groups[0], image.data, image.format, image.width_px, image.height_px, at_ns)


def _answer(handle: Handle, sample: Sample) -> Message:
    channel = service_channel(handle.label, handle.schema["result"])
    return Message(channel, 0, _ns(sample.at), encoded({"value": sample.value}))
