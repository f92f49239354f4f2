"""Exports a recording as a bag of ROS 2 in MCAP, as ``ros2 bag play`` reads it: joint states and pictures.

Facts of the layout: rosbag2's ``metadata.yaml`` and the storage plugin for MCAP, as the library rosbags writes them.
"""

import base64
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final

import msgspec
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from trade.errors import ConfigurationError
from trade_gateway.recording._channels import CompressedImage, JointStates, RawImage, Time, group_of
from trade_gateway.recording._reader import RecordedMessage, entries
from trade_gateway.ros_messages._conversion import ros_path
from trade_gateway.ros_messages._types import Message, Types

_VERSION: Final = 9
_JOINT_STATES: Final = "/joint_states"
_CAMERAS: Final = "/cameras/"
_joints: Final = msgspec.json.Decoder(JointStates).decode
_compressed: Final = msgspec.json.Decoder(CompressedImage, strict=True).decode
_raw: Final = msgspec.json.Decoder(RawImage, strict=True).decode


def write(folder: Path, recording: Path, groups: Collection[str], name_of: Callable[[str], str]) -> dict[str, int]:
    """Creates a bag.

    Args:
        folder: created; it may exist if it is empty.
        recording: its joints and pictures are exported, each at its time of arrival.
        groups: of joints; pictures are exported whatever their group.
        name_of: the name in ROS of a joint.

    Returns:
        The number of messages of each topic.

    Raises:
        ConfigurationError: the folder is not empty or cannot be written, or the recording cannot be read.
    """
    try:
        if folder.exists():
            if any(folder.iterdir()):
                raise ConfigurationError(where=str(folder), problem="is not empty; existing files are not overwritten")
            folder.rmdir()  # the library makes it
        with Writer(folder, version=_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
            return _copy(writer, recording, groups, name_of)
    except OSError as bad:
        raise ConfigurationError(where=str(folder), problem=f"cannot be written: {bad.strerror}") from None


def _copy(writer: Writer, recording: Path, groups: Collection[str], name_of: Callable[[str], str]) -> dict[str, int]:
    types, store = Types(2), get_typestore(Stores.ROS2_JAZZY)
    connections: dict[str, Connection] = {}
    written: Counter[str] = Counter()
    for entry in entries(recording):
        if (made := _message(entry, groups, name_of)) is None:
            continue
        topic, kind, message = made
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], entry.arrived_ns, types.to_bytes(kind, message))
        written[topic] += 1
    return dict(written)


def _message(
    entry: RecordedMessage, groups: Collection[str], name_of: Callable[[str], str]
) -> tuple[str, str, Message] | None:
    """The topic, the type and the message for an entry; None: it has no counterpart in ROS."""
    group = group_of(entry.topic)
    if group is not None:
        return (_JOINT_STATES, "sensor_msgs/msg/JointState", _states(entry, name_of)) if group in groups else None
    if entry.topic.startswith(_CAMERAS):
        return _picture(entry, ros_path(entry.topic.removeprefix(_CAMERAS), "image_raw"))
    return None


def _states(entry: RecordedMessage, name_of: Callable[[str], str]) -> Message:
    states = _joints(entry.data)
    return {
        "header": _header(Time.of(entry.stamp_ns), ""),
        "name": [name_of(name) for name in states.names],
        "position": states.positions,
        "velocity": states.velocities,
    }


def _picture(entry: RecordedMessage, topic: str) -> tuple[str, str, Message]:
    try:
        raw = _raw(entry.data)
    except msgspec.ValidationError:
        small = _compressed(entry.data)
        encoded: Message = {"format": small.format, "data": base64.b64decode(small.data)}
        header = _header(small.timestamp, small.frame_id)
        return f"{topic}/compressed", "sensor_msgs/msg/CompressedImage", {"header": header, **encoded}
    size: Message = {"height": raw.height, "width": raw.width, "encoding": raw.encoding, "step": raw.step}
    header = _header(raw.timestamp, raw.frame_id)
    return topic, "sensor_msgs/msg/Image", {"header": header, **size, "data": base64.b64decode(raw.data)}


def _header(at: Time, frame: str) -> Message:
    return {"stamp": {"sec": at.sec, "nanosec": at.nsec}, "frame_id": frame}
