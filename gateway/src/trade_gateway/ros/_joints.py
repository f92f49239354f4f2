"""Joints of ours by the names that ROS has for them, and where they are."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, cast

import msgspec

from trade import Container, Handle, where
from trade.errors import ConfigurationError

__all__ = ["LIMBS", "JointNames", "Measured", "beside", "joints_of", "limbs", "measured"]

LIMBS: Final = where(kind="JointGroup") | where(kind="Arm") | where(kind="Motor")
_TOLD_WITHIN_S: Final = 5.0


class Measured(NamedTuple):
    """Where joints were, in the order of their names."""

    names: Sequence[str]
    positions_rad: Sequence[float]
    velocities_rad_s: Sequence[float]
    age_s: float
    """How long ago the oldest of it was read."""


class JointNames:
    """Their names and ours.

    Args:
        joints: ours, full.
        short: whether theirs are the last words of ours.
        named: by their name ours, where they differ from that.

    Raises:
        ConfigurationError: two joints would have one name, or a name is of no joint.
    """

    def __init__(self, joints: Sequence[str], *, short: bool, named: Mapping[str, str]) -> None:
        for theirs, own in named.items():
            if own not in joints:
                problem = f"{own!r}, called {theirs!r}, is not among {', '.join(joints)}"
                raise ConfigurationError(where="joints", problem=problem)
        said = {own: theirs for theirs, own in named.items()}
        self.theirs: Final = [said.get(own, own.rpartition(".")[2] if short else own) for own in joints]
        """In the order of ours."""
        if len(set(self.theirs)) < len(joints):
            problem = f'two of {", ".join(joints)} would have one name; say names = "full", or name them in joints'
            raise ConfigurationError(where="joints", problem=problem)
        self.ours: Final = dict(zip(self.theirs, joints, strict=True))


def limbs(found: Sequence[Handle], group: str, name: str) -> list[Handle]:
    """Of services of a name those of the joint group or arm that is exactly this group; else of all motors and arms."""
    named = [handle for handle in found if handle.name == name]
    exact = [one for one in named if group in one.groups and {"JointGroup", "Arm"} & set(one.kinds)]
    return exact or [one for one in named if {"Motor", "Arm"} & set(one.kinds)]


def beside(container: Container, handle: Handle, name: str) -> Handle:
    """Another service of the same provider. Raises ConfigurationError: it has none of that name."""
    key = handle.key
    for one in container.services(where(name=name, container=handle.container)):
        if (one.key.address, one.key.domain, one.key.provider) == (key.address, key.domain, key.provider):
            return one
    raise ConfigurationError(where=handle.label, problem=f"its provider has no {name}")


def joints_of(container: Container, handle: Handle) -> list[str]:
    """Full names of the joints a service is about, in the order of its values. Raises what asking for them does."""
    told = beside(container, handle, "limits").with_(deadline_s=_TOLD_WITHIN_S)()
    limits: Any = msgspec.to_builtins(told)
    if isinstance(limits, dict):  # of an arm, or of one joint
        whole = cast("dict[str, Any]", limits)
        limits = whole.get("joints", [whole])
    return [one["name"] for one in cast("list[dict[str, Any]]", limits)]


def measured(joints: Sequence[str], state: Any) -> Measured:
    """What a motor, joint group or arm says of itself."""
    told: Any = msgspec.to_builtins(state)
    if isinstance(told, dict) and "positions_rad" in told:
        arm = cast("dict[str, Any]", told)
        return Measured(joints, arm["positions_rad"], arm["velocities_rad_s"], arm["age_s"])
    motors = cast("list[dict[str, Any]]", told if isinstance(told, list) else [told])
    return Measured(
        [motor["name"] for motor in motors],
        [motor["position_rad"] for motor in motors],
        [motor["velocity_rad_s"] for motor in motors],
        max(motor["age_s"] for motor in motors),
    )
