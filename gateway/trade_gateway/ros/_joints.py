"""Joints and grippers of TRADE under their names in ROS, and their measured positions."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple, cast

import msgspec

from trade import Container, Handle, where
from trade.errors import ConfigurationError

LIMBS: Final = where(kind="JointGroup") | where(kind="Arm") | where(kind="Motor") | where(kind="Gripper")
_LIMITS_S: Final = 5.0


class JointMeasurement(NamedTuple):
    """Positions of joints in rad and rad/s, in the order of their names; of a gripper, its width in m and m/s."""

    names: Sequence[str]
    positions: Sequence[float]
    velocities: Sequence[float]
    age_s: float
    """Age of the oldest reading in seconds."""
    is_width: bool = False
    """Whether it is of a gripper."""


def limbs(found: Sequence[Handle], group: str, name: str) -> list[Handle]:
    """Services with a name in the joint group or arm that is exactly this group; else those of all motors and arms.

    Those of grippers are always among them, as no joint group has a gripper.
    """
    named = [handle for handle in found if handle.name == name]
    grippers = [one for one in named if "Gripper" in one.kinds]
    exact = [one for one in named if group in one.groups and {"JointGroup", "Arm"} & set(one.kinds)]
    return [*(exact or [one for one in named if {"Motor", "Arm"} & set(one.kinds)]), *grippers]


def beside(container: Container, handle: Handle, name: str) -> Handle:
    """Another service of the same provider. Raises ConfigurationError: the provider has no service of that name."""
    key = handle.key
    for one in container.services(where(name=name, container=handle.container)):
        if (one.key.address, one.key.domain, one.key.provider) == (key.address, key.domain, key.provider):
            return one
    raise ConfigurationError(where=handle.label, problem=f"its provider has no {name}")


def joints_of(container: Container, handle: Handle) -> list[str]:
    """Full names of the joints of a service, in the order of its values. Raises what the call for them raises."""
    answer = beside(container, handle, "limits").with_(deadline_s=_LIMITS_S)()
    limits: Any = msgspec.to_builtins(answer)
    if isinstance(limits, dict):  # of an arm, a gripper, or one joint
        whole = cast("dict[str, Any]", limits)
        limits = whole.get("joints", [whole])
    return [one["name"] for one in cast("list[dict[str, Any]]", limits)]


def measured(joints: Sequence[str], state: Any) -> JointMeasurement:
    """Reads the positions from the state of a motor, joint group, arm or gripper."""
    plain: Any = msgspec.to_builtins(state)
    if isinstance(plain, dict) and "positions_rad" in plain:
        arm = cast("dict[str, Any]", plain)
        return JointMeasurement(joints, arm["positions_rad"], arm["velocities_rad_s"], arm["age_s"])
    if isinstance(plain, dict) and "width_m" in plain:
        hand = cast("dict[str, Any]", plain)
        return JointMeasurement(joints, [hand["width_m"]], [hand["speed_m_s"]], hand["age_s"], is_width=True)
    motors = cast("list[dict[str, Any]]", plain if isinstance(plain, list) else [plain])
    return JointMeasurement(
        [motor["name"] for motor in motors],
        [motor["position_rad"] for motor in motors],
        [motor["velocity_rad_s"] for motor in motors],
        max(motor["age_s"] for motor in motors),
    )
