"""The file of a ROS bridge: the ROS system to join and the mappings in both directions, checked as a whole."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct, structs

from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade.toml_files import Mismatch, mismatch
from trade_gateway.config._toml_file import read_toml
from trade_gateway.ros._urdf import read_urdf

_NAME: Final = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)

_Text = Annotated[str, Meta(min_length=1)]
_RosName = Annotated[str, Meta(pattern=rf"^{_NAME.pattern}$", description="/arm/command")]
_Type = Annotated[str, Meta(pattern=r"^\w+/(msg|srv|action)/\w+$", description="package/msg/Name")]
_Hz = Annotated[float, Meta(ge=0.001, le=1000)]
_Seconds = Annotated[float, Meta(gt=0, le=86_400)]
_Deadman = Annotated[float, Meta(ge=0.05, le=10)]
_Names = Literal["last", "full"]
Fields = dict[str, str]
Effect = Literal["read", "note", "actuate"]


class _Strict(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the file; unknown keys are errors."""


class Link(_Strict, frozen=True, kw_only=True):
    """``[ros]``: the ROS system."""

    version: Literal[1, 2]
    node: _RosName = "/trade"
    """Name of the bridge's node."""
    types: list[str] = []
    """Further folders of type definitions, relative to the file."""
    master: str = ""
    """ROS 1: the master's URI; by default ROS_MASTER_URI."""
    ip: str = ""
    """ROS 1: the address under which others reach this host; by default ROS_IP."""
    python: str = ""
    """ROS 1: the Python that has rospy; by default the system's."""
    router: str = ""
    """ROS 2: the endpoint of its router (rmw_zenoh); by default the one on this host."""
    domain_id: Annotated[int, Meta(ge=0, le=232)] = 0
    """ROS 2: its ROS_DOMAIN_ID."""
    grace_s: Annotated[float, Meta(ge=0, le=10)] = 1.0
    """Time from a loss of ROS until motion of its nodes stops and their locks are released: their end is invisible."""


# --- to ROS


class _ServiceChoice(_Strict, frozen=True, kw_only=True):
    group: str = ""
    """All services of this group and of the groups beneath it."""
    service: str = ""
    """One service instead: ``rosie.head.stop``."""


class ServiceEntry(_ServiceChoice, frozen=True, kw_only=True):
    """``[[to_ros.service]]``: TRADE services as ROS services."""

    type: _Type
    name: str = ""
    """With ``service``: its name in ROS; by default its group as a path, and its name."""
    names: list[str] = []
    """With ``group``: only services with these names."""
    args: Fields = {}
    """For each parameter of the service, the field of the request; not needed for equal names."""
    deadline_s: _Seconds = 10.0


class LockService(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.lock]]``: a ROS service by which a node takes (True) and releases (False) a lock over a group."""

    group: _Text
    name: str = ""
    """Its name; by default the group as a path, and ``lock``."""
    wait_s: Annotated[float, Meta(ge=0, le=60)] = 2.0


class Command(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.command]]``: messages of a ROS topic as calls of a TRADE service; the newest counts."""

    topic: _RosName
    type: _Type
    service: _Text
    args: Fields = {}
    """For each parameter of the service, the field of the message."""
    fixed: dict[str, Any] = {}
    """Further arguments: ``{ valid_s = 0.3 }``."""
    deadman_s: _Deadman = 0.5
    """Longest silence in seconds; after it, the motion is stopped."""
    deadline_s: _Seconds = 10.0
    """Deadline of each call in seconds."""


class StreamEntry(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.stream]]``: the result of a TRADE service as a ROS topic."""

    service: _Text
    topic: _RosName
    type: _Type
    hz: _Hz = 10.0
    fields: Fields = {}
    """For each field, the part of the result: ``{ data = "position_rad" }``; by default by equal names, or ``data``."""


class JointStates(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.joint_states]]``: motors, joints, arms and grippers as ``sensor_msgs/msg/JointState``."""

    group: _Text
    topic: _RosName = "/joint_states"
    hz: _Hz = 20.0
    names: _Names = "last"
    """``last``: ``pan``; ``full``: ``rosie.head.pan``."""
    joints: Fields = {}
    """For each name in ROS, the TRADE joint, where they differ otherwise."""


class TrajectoryEntry(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.trajectory]]``: joints or an arm as ``control_msgs/action/FollowJointTrajectory``."""

    group: _Text
    action: _RosName
    topic: str = ""
    """A topic of ``trajectory_msgs/msg/JointTrajectory`` beside it, for goals without an answer."""
    names: _Names = "last"
    joints: Fields = {}
    """For each name in ROS, the TRADE joint."""


class ActionEntry(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.action]]``: a TRADE service as an action of any type."""

    service: _Text
    action: _RosName
    type: _Type
    args: Fields = {}
    """For each parameter of the service, the field of the goal; not needed for equal names."""
    fixed: dict[str, Any] = {}
    """Further arguments: ``{ speed_m_s = 0.1 }``."""
    result: Fields = {}
    """For each field of the result, the part of what the service returns; by default by equal names."""
    feedback: Fields = {}
    """The same for the feedback and the service's progress."""
    deadline_s: _Seconds = 600.0


class GripperEntry(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.gripper]]``: a gripper as an action of control_msgs."""

    group: _Text
    action: _RosName
    type: Literal["control_msgs/action/GripperCommand", "control_msgs/action/ParallelGripperCommand"] = (
        "control_msgs/action/GripperCommand"
    )
    joint: str = ""
    """The joint in messages of ParallelGripperCommand; by default the last part of the group."""
    deadline_s: _Seconds = 10.0


class RobotEntry(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.robot]]``: a robot's description, and the transforms of its links."""

    group: _Text
    urdf: _Text
    """Its URDF, relative to the file."""
    topic: _RosName = "/robot_description"
    hz: _Hz = 20.0
    names: _Names = "last"
    joints: Fields = {}
    """For each name in the URDF, the TRADE joint, where they differ otherwise."""


class ToRos(_Strict, frozen=True, kw_only=True):
    """What ROS receives from TRADE."""

    service: list[ServiceEntry] = []
    lock: list[LockService] = []
    command: list[Command] = []
    stream: list[StreamEntry] = []
    joint_states: list[JointStates] = []
    trajectory: list[TrajectoryEntry] = []
    action: list[ActionEntry] = []
    gripper: list[GripperEntry] = []
    robot: list[RobotEntry] = []

    def actions(self) -> list[str]:
        """The names of all actions that the bridge serves."""
        return [one.action for one in (*self.trajectory, *self.action, *self.gripper)]


# --- from ROS


class _OfferedGroups(_Strict, frozen=True, kw_only=True):
    groups: Annotated[list[_Text], Meta(min_length=1)]
    """Groups in which it is offered; access rules apply to the first one."""
    name: str = ""
    """Name of the TRADE service; by default the last part of the ROS name."""


class FromService(_OfferedGroups, frozen=True, kw_only=True):
    """``[[from_ros.service]]``: a ROS service as a TRADE service."""

    service: _RosName
    type: _Type
    effect: Effect
    """Its effect: none (read), records something (note), or may move something (actuate)."""
    stop: str = ""
    """With ``actuate``: the ROS service, of std_srvs/srv/Trigger or Empty, that stops the motion."""
    stop_type: _Type = "std_srvs/srv/Trigger"
    deadline_s: _Seconds = 10.0


class FromTopic(_OfferedGroups, frozen=True, kw_only=True):
    """``[[from_ros.topic]]``: the latest message of a ROS topic as a TRADE service that reads."""

    topic: _RosName
    type: _Type
    stale_after_s: _Seconds = 1.0
    latched: bool = False
    """Whether the publisher keeps the last message, e.g. a map, for later subscribers. Its age is then not checked."""


class FromPublish(_OfferedGroups, frozen=True, kw_only=True):
    """``[[from_ros.publish]]``: a TRADE service that publishes."""

    topic: _RosName
    type: _Type
    effect: Literal["note", "actuate"]
    stop: dict[str, Any] | None = None
    """With ``actuate``: the message that stops the motion."""
    valid_s: Annotated[float, Meta(ge=0, le=1)] = 0.5
    """Validity of each message in seconds, unless another follows; then ``stop`` is published. 0: the motion ends by
    itself, and ``stop`` is published when its session ends."""


class FromAction(_OfferedGroups, frozen=True, kw_only=True):
    """``[[from_ros.action]]``: an action of ROS as a TRADE service with progress, a result and a stop."""

    action: _RosName
    type: _Type
    effect: Literal["note", "actuate"] = "actuate"
    """``note``: it moves nothing, needs no lock and has no stop."""


class FromJoints(_Strict, frozen=True, kw_only=True):
    """``[[from_ros.joints]]``: joints of ROS, by a topic and an action, as a TRADE provider."""

    groups: Annotated[list[_Text], Meta(min_length=1)]
    action: _RosName
    joints: Annotated[list[_Text], Meta(min_length=1)]
    """Their names in ROS; in TRADE each is ``GROUP.NAME``."""
    topic: _RosName = "/joint_states"
    stale_after_s: _Seconds = 0.5
    max_speed_rad_s: Annotated[float, Meta(gt=0)] = 0.5
    """Greatest speed of ``move_to`` in rad/s."""


class FromParameters(_Strict, frozen=True, kw_only=True):
    """``[[from_ros.parameters]]``: the parameters of a ROS node."""

    groups: Annotated[list[_Text], Meta(min_length=1)]
    node: _RosName
    set: bool = False
    """Whether clients may also set them."""
    deadline_s: _Seconds = 5.0


class FromRos(_Strict, frozen=True, kw_only=True):
    """What TRADE receives from ROS."""

    service: list[FromService] = []
    topic: list[FromTopic] = []
    publish: list[FromPublish] = []
    action: list[FromAction] = []
    joints: list[FromJoints] = []
    parameters: list[FromParameters] = []


class RosFile(_Strict, frozen=True, kw_only=True):
    """The whole file."""

    ros: Link
    to_ros: ToRos = ToRos()
    from_ros: FromRos = FromRos()

    def folders(self, path: Path) -> list[Path]:
        """Folders of type definitions."""
        return [path.parent / folder for folder in self.ros.types]


def read_ros_file(path: Path) -> RosFile:
    """Reads and checks a file.

    Raises:
        ConfigurationError: the file cannot be read, or an entry is wrong; the error says where, and what is valid.
    """
    _, raw = read_toml(path)
    try:
        read = _placed(msgspec.convert(raw, RosFile), path.parent)
    except msgspec.ValidationError as bad:
        raise _explained(path, mismatch(bad)) from None
    for entry in read.to_ros.robot:
        _read_description(entry)
    for place, problem in _problems(read):
        raise ConfigurationError(where=f"{path}: {place}", problem=problem)
    return read


def _placed(read: RosFile, folder: Path) -> RosFile:
    """The same with whole paths."""
    robots = [structs.replace(entry, urdf=str(folder / entry.urdf)) for entry in read.to_ros.robot]
    return structs.replace(read, to_ros=structs.replace(read.to_ros, robot=robots))


def _read_description(entry: RobotEntry) -> None:
    try:
        read_urdf(read_text(Path(entry.urdf)), entry.urdf)
    except (OSError, UnicodeDecodeError) as bad:
        raise ConfigurationError(where=entry.urdf, problem=f"cannot be read: {bad}") from None


def _explained(path: Path, found: Mismatch) -> ConfigurationError:
    place, problem, missing, unknown = found
    if missing:
        place, problem = f"{place}.{missing}".lstrip("."), "is missing"
    elif unknown:
        place, problem = f"{place}.{unknown}".lstrip("."), "unknown key; docs/ros.md lists the valid ones"
    elif "matching regex" in problem and "msg|srv|action" in problem:
        problem = "a type is written package/msg/NAME, package/srv/NAME or package/action/NAME: std_msgs/msg/Float64"
    elif "matching regex" in problem:
        problem = "is not a ROS name: words of letters, digits and _, joined by /, such as /head/command"
    return ConfigurationError(where=f"{path}: {place}" if place else str(path), problem=problem)


def _problems(read: RosFile) -> Iterable[tuple[str, str]]:
    """Yields contradictions between entries: where, and what."""
    for number, entry in enumerate(read.to_ros.service):
        yield from _of_one(f"to_ros.service[{number}]", entry)
    for number, offered in enumerate(read.from_ros.service):
        place = f"from_ros.service[{number}].stop"
        if offered.effect == "actuate" and not offered.stop:
            yield place, 'is missing: what moves something needs a ROS service that stops it, or effect = "note"'
        if offered.effect != "actuate" and offered.stop:
            yield place, f'does not go with effect = "{offered.effect}", which moves nothing'
    for number, published in enumerate(read.from_ros.publish):
        place = f"from_ros.publish[{number}].stop"
        if published.effect == "actuate" and published.stop is None:
            yield place, "is missing: what moves something needs a message that stops it, such as { linear = {} }"
        if published.effect == "note" and published.stop is not None:
            yield place, 'does not go with effect = "note", which moves nothing'
    for number, trajectory in enumerate(read.to_ros.trajectory):
        if trajectory.topic and not _NAME.fullmatch(trajectory.topic):
            yield f"to_ros.trajectory[{number}].topic", "is not a ROS name: words of letters, digits and _, joined by /"
    yield from _twice("to_ros.trajectory", [one.topic for one in read.to_ros.trajectory if one.topic])
    yield from _twice("to_ros.lock", [one.name or one.group for one in read.to_ros.lock])
    yield from _twice("to_ros.service", [one.name for one in read.to_ros.service if one.name])
    yield from _twice("to_ros", read.to_ros.actions())
    yield from _twice("to_ros.robot", [one.topic for one in read.to_ros.robot])
    yield from _twice("to_ros.command", [one.topic for one in read.to_ros.command])
    yield from _circles(read)


def _of_one(place: str, entry: ServiceEntry) -> Iterable[tuple[str, str]]:
    if bool(entry.group) == bool(entry.service):
        yield place, 'needs either group = "rosie.head" or service = "rosie.head.stop"'
    if entry.name and not entry.service:
        yield f"{place}.name", "names one service. Use service instead of group"
    if entry.name and not _NAME.fullmatch(entry.name):
        yield f"{place}.name", "is not a ROS name: words of letters, digits and _, joined by /"
    if entry.names and not entry.group:
        yield f"{place}.names", "selects services of a group. Remove it, or use group instead of service"


def _twice(place: str, names: Sequence[str]) -> Iterable[tuple[str, str]]:
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield place, f"{name} occurs twice. Keep one entry for each name"


def _circles(read: RosFile) -> Iterable[tuple[str, str]]:
    """Yields mappings that would return to their origin."""
    published = {entry.topic for entry in (*read.to_ros.stream, *read.to_ros.joint_states)}
    for name in sorted(published & {entry.topic for entry in read.from_ros.topic}):
        yield "from_ros.topic", f"{name} is published by this bridge itself. Remove one of the two entries"
    served = set(read.to_ros.actions())
    for kind, entries in (("joints", read.from_ros.joints), ("action", read.from_ros.action)):
        for name in sorted(served & {one.action for one in entries}):
            yield f"from_ros.{kind}", f"{name} is served by this bridge itself. Remove one of the two entries"
    for name in sorted({one.topic for one in read.to_ros.command} & {one.topic for one in read.from_ros.publish}):
        yield "from_ros.publish", f"{name} would command the bridge's own service again. Remove one of the two entries"
