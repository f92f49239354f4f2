"""The joints of a URDF, and the transforms of the links behind them. No input or output.

Facts of the format: "urdf/XML" on wiki.ros.org. Angles of ``rpy`` turn about the fixed axes x, y and z, in this order.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple
from xml.etree.ElementTree import Element, ParseError, fromstring

from trade.errors import ConfigurationError

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""

_TURNS: Final = ("revolute", "continuous")
_KINDS: Final = (*_TURNS, "prismatic", "fixed")
_FORBIDDEN: Final = ("<!DOCTYPE", "<!ENTITY")


class Transform(NamedTuple):
    """Where a link is in the frame of its parent."""

    xyz_m: Vector
    rotation: Quaternion


class Mimic(NamedTuple):
    """A joint's position as a linear function of another one's."""

    joint: str
    multiplier: float
    offset: float


class UrdfJoint(NamedTuple):
    """One joint."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Transform
    """Of the child at position 0."""
    axis: Vector
    """Of length 1, in the frame of the joint."""
    mimic: Mimic | None

    @property
    def fixed(self) -> bool:
        """Whether it never moves."""
        return self.kind == "fixed"

    @property
    def turns(self) -> bool:
        """Whether its position is an angle in rad."""
        return self.kind in _TURNS

    def at(self, position: float) -> Transform:
        """The transform of its child at a position in rad or m."""
        xyz, rotation = self.origin
        if self.turns:
            sine = math.sin(position / 2)
            x, y, z = self.axis
            return Transform(xyz, _product(rotation, (x * sine, y * sine, z * sine, math.cos(position / 2))))
        shift = _turned(rotation, (self.axis[0] * position, self.axis[1] * position, self.axis[2] * position))
        return Transform((xyz[0] + shift[0], xyz[1] + shift[1], xyz[2] + shift[2]), rotation)


def read_urdf(text: str, where: str) -> list[UrdfJoint]:
    """The joints of a description, in its order.

    Args:
        text: the description.
        where: its file, for errors.

    Raises:
        ConfigurationError: it is no URDF, or has a joint that is incomplete or of an unknown type.
    """
    if any(word in text for word in _FORBIDDEN):
        raise ConfigurationError(where=where, problem="has a document type or entities, which a URDF does not need")
    try:
        root = fromstring(text)  # noqa: S314 - without a document type it has nothing to expand
    except ParseError as bad:
        raise ConfigurationError(where=where, problem=f"is not XML: {bad}") from None
    if root.tag != "robot":
        hint = ". Run xacro first" if "xacro" in text else ""
        raise ConfigurationError(where=where, problem=f"its root is <{root.tag}>, not <robot>{hint}")
    joints = [_joint(node, f"{where}: joint {node.get('name', '')!r}") for node in root.findall("joint")]
    names = [joint.name for joint in joints]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigurationError(where=where, problem=f"two joints are called {twice[0]!r}")
    return joints


def _joint(node: Element, where: str) -> UrdfJoint:
    name, kind = node.get("name", ""), node.get("type", "")
    if not name or kind not in _KINDS:
        problem = f"its type is {kind!r}; the bridge knows {', '.join(_KINDS)}" if name else "a joint needs a name"
        raise ConfigurationError(where=where, problem=problem)
    ends = [found.get("link", "") if (found := node.find(end)) is not None else "" for end in ("parent", "child")]
    if not all(ends):
        raise ConfigurationError(where=where, problem="needs a parent and a child, each with a link")
    origin = node.find("origin")
    xyz, rpy = (_vector(origin, key, (0.0, 0.0, 0.0), where) for key in ("xyz", "rpy"))
    axis = _vector(node.find("axis"), "xyz", (1.0, 0.0, 0.0), where)
    length = math.hypot(*axis)
    if not length:
        raise ConfigurationError(where=where, problem="its axis has no direction")
    unit = (axis[0] / length, axis[1] / length, axis[2] / length)
    transform = Transform(xyz, _rotation(*rpy))
    return UrdfJoint(name, kind, ends[0], ends[1], transform, unit, _mimic(node.find("mimic"), where))


def _mimic(node: Element | None, where: str) -> Mimic | None:
    if node is None:
        return None
    numbers = [_numbers(node.get(key, default), 1, where)[0] for key, default in (("multiplier", "1"), ("offset", "0"))]
    return Mimic(node.get("joint", ""), *numbers)


def _vector(node: Element | None, key: str, default: Vector, where: str) -> Vector:
    if node is None or (text := node.get(key)) is None:
        return default
    x, y, z = _numbers(text, 3, where)
    return (x, y, z)


def _numbers(text: str, count: int, where: str) -> Sequence[float]:
    try:
        found = [float(word) for word in text.split()]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise ConfigurationError(where=where, problem=f"{text!r} is not {count} finite numbers")
    return found


def _rotation(roll: float, pitch: float, yaw: float) -> Quaternion:
    about = [(math.sin(angle / 2), math.cos(angle / 2)) for angle in (roll, pitch, yaw)]
    (sr, cr), (sp, cp), (sy, cy) = about
    return _product((0.0, 0.0, sy, cy), _product((0.0, sp, 0.0, cp), (sr, 0.0, 0.0, cr)))


def _product(one: Quaternion, other: Quaternion) -> Quaternion:
    x1, y1, z1, w1 = one
    x2, y2, z2, w2 = other
    return (
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    )


def _turned(rotation: Quaternion, vector: Vector) -> Vector:
    x, y, z, w = rotation
    turned = _product(_product(rotation, (*vector, 0.0)), (-x, -y, -z, w))
    return (turned[0], turned[1], turned[2])
