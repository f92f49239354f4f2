"""The file of a ROS bridge: which ROS system it joins, and what of each side the other one has. Checked as a whole."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct

from trade._toml import read_toml_text
from trade.errors import ConfigurationError

__all__ = [
    "Command",
    "FromJoints",
    "FromParameters",
    "FromPublish",
    "FromService",
    "FromTopic",
    "JointStates",
    "Link",
    "LockService",
    "RosFile",
    "ServiceEntry",
    "StreamEntry",
    "TrajectoryEntry",
    "read_ros_file",
]

_AT: Final = re.compile(r" - at `\$\.?([^`]*)`$")
_MISSING: Final = re.compile(r"missing required field `([^`]*)`")
_UNKNOWN: Final = re.compile(r"contains unknown field `([^`]*)`")
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
    """A table of the file: what it does not know it refuses."""


class Link(_Strict, frozen=True, kw_only=True):
    """``[ros]``: the ROS system."""

    version: Literal[1, 2]
    node: _RosName = "/trade"
    """What the bridge is called there."""
    types: list[str] = []
    """Folders of definitions beyond those that come along, beside the file."""
    master: str = ""
    """ROS 1: its URI; by default that of ROS_MASTER_URI."""
    ip: str = ""
    """ROS 1: where this host is reached by others; by default that of ROS_IP."""
    python: str = ""
    """ROS 1: the Python that has rospy; by default the system's."""
    router: str = ""
    """ROS 2: the endpoint of its router (rmw_zenoh); by default the one of this host."""
    domain_id: Annotated[int, Meta(ge=0, le=232)] = 0
    """ROS 2."""
    grace_s: Annotated[float, Meta(ge=0, le=10)] = 1.0
    """So long after ROS is lost, what its nodes move stops and their locks fall: nobody sees any more who dies."""


# --- to ROS


class _Of(_Strict, frozen=True, kw_only=True):
    group: str = ""
    """All services of it, and of those beneath it."""
    service: str = ""
    """Or this one: ``rosie.head.stop``."""


class ServiceEntry(_Of, frozen=True, kw_only=True):
    """``[[to_ros.service]]``: services of ours as services of ROS."""

    type: _Type
    name: str = ""
    """With ``service``: what it is called there; by default its group as a path, and its name."""
    names: list[str] = []
    """With ``group``: only services of these names."""
    args: Fields = {}
    """By our parameter, their field; those of one name need no word."""
    deadline_s: _Seconds = 10.0


class LockService(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.lock]]``: a node takes (True) and gives back (False) a lock over a group."""

    group: _Text
    name: str = ""
    """By default the group as a path, and ``lock``."""
    wait_s: Annotated[float, Meta(ge=0, le=60)] = 2.0


class Command(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.command]]``: messages of theirs as calls of a service of ours, the newest wins."""

    topic: _RosName
    type: _Type
    service: _Text
    args: Fields = {}
    """By our parameter, their field."""
    fixed: dict[str, Any] = {}
    """Further arguments: ``{ valid_s = 0.3 }``."""
    deadman_s: _Deadman = 0.5
    """Silence for longer than this stops it."""
    deadline_s: _Seconds = 10.0
    """Of each call."""


class StreamEntry(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.stream]]``: what a service of ours reads, as a topic."""

    service: _Text
    topic: _RosName
    type: _Type
    hz: _Hz = 10.0
    fields: Fields = {}
    """By their field, ours: ``{ data = "position_rad" }``; by default those of one name, or ``data``."""


class JointStates(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.joint_states]]``: motors, joints or an arm as ``sensor_msgs/msg/JointState``."""

    group: _Text
    topic: _RosName = "/joint_states"
    hz: _Hz = 20.0
    names: _Names = "last"
    """``last``: ``pan``; ``full``: ``rosie.head.pan``."""
    joints: Fields = {}
    """By their name, ours, where they differ otherwise."""


class TrajectoryEntry(_Strict, frozen=True, kw_only=True):
    """``[[to_ros.trajectory]]``: joints or an arm as ``control_msgs/action/FollowJointTrajectory``."""

    group: _Text
    action: _RosName
    names: _Names = "last"
    joints: Fields = {}
    """By their name, ours."""


class ToRos(_Strict, frozen=True, kw_only=True):
    """What ROS has of ours."""

    service: list[ServiceEntry] = []
    lock: list[LockService] = []
    command: list[Command] = []
    stream: list[StreamEntry] = []
    joint_states: list[JointStates] = []
    trajectory: list[TrajectoryEntry] = []


# --- from ROS


class _Offered(_Strict, frozen=True, kw_only=True):
    groups: Annotated[list[_Text], Meta(min_length=1)]
    """In which it is offered; the first one settles who may call it."""
    name: str = ""
    """Of our service; by default the last word of theirs."""


class FromService(_Offered, frozen=True, kw_only=True):
    """``[[from_ros.service]]``: a service of theirs as one of ours."""

    service: _RosName
    type: _Type
    effect: Effect
    """What a call of it does: nothing (read), writes something down (note), may move something (actuate)."""
    stop: str = ""
    """With ``actuate``: the service of theirs, of std_srvs/srv/Trigger or Empty, that ends it."""
    stop_type: _Type = "std_srvs/srv/Trigger"
    deadline_s: _Seconds = 10.0


class FromTopic(_Offered, frozen=True, kw_only=True):
    """``[[from_ros.topic]]``: the latest message of a topic of theirs as a service of ours that reads."""

    topic: _RosName
    type: _Type
    stale_after_s: _Seconds = 1.0
    latched: bool = False
    """Its publisher keeps the last message for who comes later, such as a map: that is told however old it is."""


class FromPublish(_Offered, frozen=True, kw_only=True):
    """``[[from_ros.publish]]``: a service of ours that publishes."""

    topic: _RosName
    type: _Type
    effect: Literal["note", "actuate"]
    stop: dict[str, Any] | None = None
    """With ``actuate``: the message that ends what it moves."""
    valid_s: Annotated[float, Meta(ge=0, le=1)] = 0.5
    """So long each holds, then ``stop`` is published, unless another one comes before; 0: what it asks for has an end
    of its own, and ``stop`` is published when its session ends."""


class FromJoints(_Strict, frozen=True, kw_only=True):
    """``[[from_ros.joints]]``: joints of theirs, by a topic and an action, as a provider of ours."""

    groups: Annotated[list[_Text], Meta(min_length=1)]
    action: _RosName
    joints: Annotated[list[_Text], Meta(min_length=1)]
    """Their names there; here each is ``GROUP.NAME``."""
    topic: _RosName = "/joint_states"
    stale_after_s: _Seconds = 0.5
    max_speed_rad_s: Annotated[float, Meta(gt=0)] = 0.5
    """The greatest speed of ``move_to``."""


class FromParameters(_Strict, frozen=True, kw_only=True):
    """``[[from_ros.parameters]]``: what a node of theirs has as parameters."""

    groups: Annotated[list[_Text], Meta(min_length=1)]
    node: _RosName
    set: bool = False
    """Whether they may be set, too."""
    deadline_s: _Seconds = 5.0


class FromRos(_Strict, frozen=True, kw_only=True):
    """What ours have of ROS."""

    service: list[FromService] = []
    topic: list[FromTopic] = []
    publish: list[FromPublish] = []
    joints: list[FromJoints] = []
    parameters: list[FromParameters] = []


class RosFile(_Strict, frozen=True, kw_only=True):
    """The whole file."""

    ros: Link
    to_ros: ToRos = ToRos()
    from_ros: FromRos = FromRos()

    def folders(self, path: Path) -> list[Path]:
        """Of definitions."""
        return [path.parent / folder for folder in self.ros.types]


def read_ros_file(path: Path) -> RosFile:
    """Read it.

    Raises:
        ConfigurationError: it cannot be read, or something in it is wrong: says where, and what would be right.
    """
    try:
        raw = read_toml_text(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad}") from None
    try:
        read = msgspec.convert(raw, RosFile)
    except msgspec.ValidationError as bad:
        raise _explained(path, str(bad)) from None
    for place, problem in _problems(read):
        raise ConfigurationError(where=f"{path}: {place}", problem=problem)
    return read


def _explained(path: Path, said: str) -> ConfigurationError:
    found = _AT.search(said)
    place, problem = (found.group(1), said[: found.start()]) if found else ("", said)
    if missing := _MISSING.search(problem):
        place, problem = f"{place}.{missing.group(1)}".lstrip("."), "is missing"
    elif unknown := _UNKNOWN.search(problem):
        place, problem = f"{place}.{unknown.group(1)}".lstrip("."), "unknown key; docs/ros.md says which there are"
    elif "matching regex" in problem and "msg|srv|action" in problem:
        problem = "a type is written std_msgs/msg/Float64: package/msg/NAME, package/srv/NAME or package/action/NAME"
    elif "matching regex" in problem:
        problem = "is no name of ROS: words of letters, digits and _, joined by /, such as /head/command"
    return ConfigurationError(where=f"{path}: {place}" if place else str(path), problem=problem)


def _problems(read: RosFile) -> Iterable[tuple[str, str]]:
    """Where something contradicts something else, and what."""
    for number, entry in enumerate(read.to_ros.service):
        yield from _of_one(f"to_ros.service[{number}]", entry)
    for number, offered in enumerate(read.from_ros.service):
        place = f"from_ros.service[{number}].stop"
        if offered.effect == "actuate" and not offered.stop:
            yield place, 'is missing: what moves something needs a service of theirs that stops it, or effect = "note"'
        if offered.effect != "actuate" and offered.stop:
            yield place, f'does not go with effect = "{offered.effect}", which moves nothing'
    for number, published in enumerate(read.from_ros.publish):
        place = f"from_ros.publish[{number}].stop"
        if published.effect == "actuate" and published.stop is None:
            yield place, "is missing: what moves something needs a message that stops it, such as { linear = {} }"
        if published.effect == "note" and published.stop is not None:
            yield place, 'does not go with effect = "note", which moves nothing'
    yield from _twice("to_ros.lock", [one.name or one.group for one in read.to_ros.lock])
    yield from _twice("to_ros.service", [one.name for one in read.to_ros.service if one.name])
    yield from _twice("to_ros.trajectory", [one.action for one in read.to_ros.trajectory])
    yield from _twice("to_ros.command", [one.topic for one in read.to_ros.command])
    yield from _circles(read)


def _of_one(place: str, entry: ServiceEntry) -> Iterable[tuple[str, str]]:
    if bool(entry.group) == bool(entry.service):
        yield place, 'say what: group = "rosie.head" or service = "rosie.head.stop", one of them'
    if entry.name and not entry.service:
        yield f"{place}.name", "names one service; say service instead of group"
    if entry.name and not _NAME.fullmatch(entry.name):
        yield f"{place}.name", "is no name of ROS: words of letters, digits and _, joined by /"
    if entry.names and not entry.group:
        yield f"{place}.names", "chooses among those of a group; leave it out with service"


def _twice(place: str, names: Sequence[str]) -> Iterable[tuple[str, str]]:
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield place, f"{name} is there twice; one name, one entry"


def _circles(read: RosFile) -> Iterable[tuple[str, str]]:
    """What would come back to where it came from."""
    ours = {entry.topic for entry in (*read.to_ros.stream, *read.to_ros.joint_states)}
    for name in sorted(ours & {entry.topic for entry in read.from_ros.topic}):
        yield "from_ros.topic", f"{name} is what this bridge publishes itself; leave one of the two out"
    for name in sorted({one.action for one in read.to_ros.trajectory} & {one.action for one in read.from_ros.joints}):
        yield "from_ros.joints", f"{name} is what this bridge serves itself; leave one of the two out"
    for name in sorted({one.topic for one in read.to_ros.command} & {one.topic for one in read.from_ros.publish}):
        yield "from_ros.publish", f"{name} would command our own service again; leave one of the two out"
