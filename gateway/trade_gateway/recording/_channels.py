"""The channels of a recording, their messages, and the JSON Schemas that describe them in the file."""

import base64
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Final, Literal, NamedTuple, cast

import msgspec
from msgspec import Meta, Struct

_JOINTS: Final = "/joints"
Base64 = Annotated[str, Meta(extra_json_schema={"contentEncoding": "base64"})]
FaultKind = Literal["health", "gone", "unreadable", "joint", "e-stop"]
Index = Annotated[int, Meta(ge=0)]


class JointStates(Struct, frozen=True, kw_only=True):
    """The measurements at the joints of a group, or at a gripper; all lists are in the order of the names."""

    names: list[str]
    position_rad: list[float]
    """Empty for a gripper."""
    velocity_rad_s: list[float]
    """Empty for a gripper, and for joints of ROS without speeds."""
    width_m: list[float] = []
    """Of a gripper: the distance between its fingers."""
    speed_m_s: list[float] = []
    """Of a gripper: the rate of change of its width."""
    load: list[float]
    """Effort as a fraction of the motor's maximum; empty: the device does not report it."""
    enabled: list[bool]
    """Empty: the device does not report it, as joints of ROS."""
    fault: list[str]
    """Empty: the device does not report it, as joints of ROS."""
    stamp_s: list[float]
    """Times of the measurements: seconds since the epoch, on the time of the recording (`Timeline`)."""

    @property
    def is_gripper(self) -> bool:
        """Whether positions are widths in m."""
        return bool(self.width_m)

    @property
    def is_ros(self) -> bool:
        """Whether they are joints of ROS."""
        return not self.enabled

    @property
    def positions(self) -> list[float]:
        """Angles in rad, or the width of a gripper in m."""
        return self.width_m or self.position_rad

    @property
    def velocities(self) -> list[float]:
        """Speeds in rad/s, or of a gripper in m/s."""
        return self.speed_m_s or self.velocity_rad_s


class Call(Struct, frozen=True, kw_only=True):
    """One call, as a container traced it. Without arguments and results."""

    call_id: str
    calls: list[str]
    """Ids of the calls that led to it, nearest first."""
    service: str
    side: Literal["asked", "served"]
    container: str
    caller: str
    session: str
    began_s: float
    """Seconds since the epoch, on the time of the recording."""
    waited_s: float
    took_s: float
    outcome: str
    """``ok``, or the type of its error."""
    locks: list[str]


class Lock(Struct, frozen=True, kw_only=True):
    """One lock in one container."""

    container: str
    resources: list[str]
    owner: str
    purpose: str
    since_s: float
    """Seconds since the epoch, on the time of the recording."""
    waiting: list[str]


class Locks(Struct, frozen=True, kw_only=True):
    """All locks of the system at one moment."""

    locks: list[Lock]


class Fault(Struct, frozen=True, kw_only=True):
    """A change of a fault."""

    about: str
    """A group with its health or its lost services, an unreadable service, a joint, or an e-stop."""
    kind: FaultKind
    text: str
    """The fault; empty: it has ended."""
    new: bool = True
    """False: it existed when the recording began."""


class Time(Struct, frozen=True):
    """A time, as Foxglove writes it."""

    sec: Index
    nsec: Annotated[int, Meta(ge=0, le=999_999_999)]

    @classmethod
    def of(cls, at_ns: int) -> "Time":
        """Converts nanoseconds since the epoch."""
        return cls(*divmod(at_ns, 1_000_000_000))


class CompressedImage(Struct, frozen=True, kw_only=True):
    """An encoded picture; with Foxglove's name and fields."""

    timestamp: Time
    frame_id: str
    data: Base64
    format: str


class RawImage(Struct, frozen=True, kw_only=True):
    """Pixels row by row; with Foxglove's name and fields."""

    timestamp: Time
    frame_id: str
    width: Index
    height: Index
    encoding: str
    step: Index
    data: Base64


class Channel(NamedTuple):
    """A topic whose messages have one schema."""

    topic: str
    schema_name: str
    schema: bytes
    """The JSON Schema of an object."""


class Message(NamedTuple):
    """One entry of a recording."""

    channel: Channel
    arrived_ns: int
    """Its time of arrival here, in nanoseconds since the epoch."""
    stamp_ns: int
    """The time of its content, on the time of the recording."""
    data: bytes


def inlined(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Inlines all references of a schema, as viewers do not follow them; a recursive part accepts anything."""
    definitions = cast("Mapping[str, Any]", schema.get("$defs", {}))

    def within(node: Any, open_: tuple[str, ...]) -> Any:
        if isinstance(node, list):
            return [within(each, open_) for each in cast("list[Any]", node)]
        if not isinstance(node, Mapping):
            return node
        found = cast("Mapping[str, Any]", node)
        if (reference := found.get("$ref")) is not None:
            name = str(reference).rpartition("/")[2]
            return {} if name in open_ else within(definitions[name], (*open_, name))
        return {key: within(value, open_) for key, value in found.items() if key != "$defs"}

    return cast("dict[str, Any]", within(schema, ()))


def _schema(type_: type[Struct], title: str) -> bytes:
    return msgspec.json.encode({**inlined(msgspec.json.schema(type_)), "title": title})


def _channel(topic: str, type_: type[Struct], name: str) -> Channel:
    return Channel(topic, name, _schema(type_, name))


CALLS: Final = _channel("/calls", Call, "trade.Call")
LOCKS: Final = _channel("/locks", Locks, "trade.Locks")
FAULTS: Final = _channel("/faults", Fault, "trade.Fault")


@cache
def joints_channel(group: str) -> Channel:
    """The channel of a group's joints: ``/rosie.head/joints``."""
    return _channel(f"/{group}{_JOINTS}", JointStates, "trade.JointStates")


def group_of(topic: str) -> str | None:
    """The group of a joint topic; None: it is another topic."""
    return topic[1 : -len(_JOINTS)] if topic.endswith(_JOINTS) else None


@cache
def camera_channel(group: str, raw: bool) -> Channel:
    """The channel of a camera's pictures: ``/cameras/rosie.eye``."""
    if raw:
        return _channel(f"/cameras/{group}", RawImage, "foxglove.RawImage")
    return _channel(f"/cameras/{group}", CompressedImage, "foxglove.CompressedImage")


def service_channel(label: str, result: Mapping[str, Any]) -> Channel:
    """The channel of a service's results, each as ``value`` of an object: ``/services/rosie.hand.state``."""
    wrapped = {"title": label, "type": "object", "properties": {"value": inlined(result)}, "required": ["value"]}
    return Channel(f"/services/{label}", label, msgspec.json.encode(wrapped))


def picture(group: str, data: bytes, layout: str, width_px: int, height_px: int, at_ns: int) -> Message:
    """Builds the message of a camera's picture, without its time of arrival."""
    text = base64.b64encode(data).decode()
    bytes_a_pixel = {"rgb8": 3, "mono8": 1}.get(layout)
    if bytes_a_pixel is None:
        value: Struct = CompressedImage(timestamp=Time.of(at_ns), frame_id=group, data=text, format=layout)
    else:
        value = RawImage(
            timestamp=Time.of(at_ns),
            frame_id=group,
            width=width_px,
            height=height_px,
            encoding=layout,
            step=width_px * bytes_a_pixel,
            data=text,
        )
    return Message(camera_channel(group, bytes_a_pixel is not None), 0, at_ns, encoded(value))


def encoded(value: Any) -> bytes:
    """Encodes a message as JSON; values that JSON does not have, such as handles, become text."""
    return msgspec.json.encode(value, enc_hook=str)
