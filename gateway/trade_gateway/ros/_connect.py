"""Connects to the ROS system that a file names, and lists the file's mappings."""

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

from trade.errors import ConfigurationError
from trade_gateway.ros._file import RosFile
from trade_gateway.ros._graph import Graph
from trade_gateway.ros_messages._conversion import ros_path
from trade_gateway.ros_messages._types import Types, installed_definitions


class _RosVersion(NamedTuple):
    module: str
    kind: str
    says: tuple[str, ...]
    """Keys of ``[ros]`` for this version only; empty texts mean its defaults."""


_SIDES: Final = {
    1: _RosVersion("trade_gateway.ros.ros1", "Ros1", ("master", "python", "ip")),
    2: _RosVersion("trade_gateway.ros.ros2", "Ros2", ("router", "domain_id")),
}


def join(read: RosFile, path: Path) -> Graph:
    """Joins the ROS system that the file names, as a node.

    Raises:
        ConfigurationError: support for that ROS is not installed, or the file has keys of the other version.
        RosUnreachable: the system does not answer.
    """
    side = _SIDES[read.ros.version]
    _refuse_others(read, path)
    options: dict[str, Any] = {
        name: value for name in side.says if (value := getattr(read.ros, name)) not in ("", None)
    }
    try:
        kind = getattr(import_module(side.module), side.kind)
    except ImportError as missing:
        problem = f"this installation cannot communicate with ROS {read.ros.version}: {missing}"
        raise ConfigurationError(where=f"{path}: ros.version", problem=problem) from None
    return kind(node=f"/{read.ros.node.strip('/')}", folders=tuple(read.folders(path)), **options)


def _refuse_others(read: RosFile, path: Path) -> None:
    for version, side in _SIDES.items():
        for name in side.says if version != read.ros.version else ():
            if getattr(read.ros, name):
                problem = f"is a key for ROS {version}, but version is {read.ros.version}. Remove the key"
                raise ConfigurationError(where=f"{path}: ros.{name}", problem=problem)


def planned(read: RosFile, path: Path) -> list[str]:
    """Returns one line for each mapping of a file.

    Raises:
        ConfigurationError: a type is not known, or has the wrong kind.
    """
    _refuse_others(read, path)
    types = Types(read.ros.version, read.folders(path), installed_definitions(read.ros.version))
    return [*_to_ros(read, types), *_from_ros(read, types)]


def _to_ros(read: RosFile, types: Types) -> Iterable[str]:
    out = read.to_ros
    for entry in out.service:
        types.parts(entry.type)
        what = entry.service or f"services of {entry.group}" + (f" named {', '.join(entry.names)}" * bool(entry.names))
        group, _, name = entry.service.rpartition(".")
        where = (entry.name or ros_path(group, name)) if entry.service else f"under {ros_path(entry.group)}/"
        yield f"to ROS: {what} as {entry.type} {where}"
    for lock in out.lock:
        yield f"to ROS: a lock over {lock.group} as std_srvs/srv/SetBool {lock.name or ros_path(lock.group, 'lock')}"
    for command in out.command:
        types.fields(command.type)
        silence = f"stopped after {command.deadman_s:g} s of silence"
        yield f"to ROS: topic {command.topic} ({command.type}) calls {command.service}, {silence}"
    for stream in out.stream:
        types.fields(stream.type)
        yield f"to ROS: {stream.service} as topic {stream.topic} ({stream.type}) at {stream.hz:g} Hz"
    for states in out.joint_states:
        yield f"to ROS: joints of {states.group} as topic {states.topic} at {states.hz:g} Hz"
    for robot in out.robot:
        yield f"to ROS: {robot.urdf} as topic {robot.topic}, and joints of {robot.group} as /tf at {robot.hz:g} Hz"
    for way in out.trajectory:
        beside = f" and topic {way.topic}" if way.topic else ""
        yield f"to ROS: joints of {way.group} as action {way.action}{beside}"
    for action in out.action:
        types.parts(action.type)
        yield f"to ROS: {action.service} as action {action.action} ({action.type})"
    for gripper in out.gripper:
        types.parts(gripper.type)
        yield f"to ROS: gripper {gripper.group} as action {gripper.action} ({gripper.type})"


def _from_ros(read: RosFile, types: Types) -> Iterable[str]:
    into = read.from_ros
    for entry in into.service:
        types.parts(entry.type)
        yield f"from ROS: service {entry.service} ({entry.type}, {entry.effect}) in {', '.join(entry.groups)}"
    for topic in into.topic:
        types.fields(topic.type)
        yield f"from ROS: topic {topic.topic} ({topic.type}) in {', '.join(topic.groups)}"
    for published in into.publish:
        types.fields(published.type)
        yield f"from ROS: publishing on {published.topic} ({published.type}) in {', '.join(published.groups)}"
    for action in into.action:
        types.parts(action.type)
        yield f"from ROS: action {action.action} ({action.type}, {action.effect}) in {', '.join(action.groups)}"
    for joints in into.joints:
        yield f"from ROS: joints of action {joints.action} in {', '.join(joints.groups)}"
    for parameters in into.parameters:
        yield f"from ROS: parameters of {parameters.node} in {', '.join(parameters.groups)}"
