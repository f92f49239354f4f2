"""The scenes of a drill: what fails during a motion, and how soon the motion must end. Pure data."""

from typing import Final, Literal

from msgspec import Struct

from trade_checks.drill._targets import Target
from trade_robotfile import Drill

ALLOWANCE_S: Final = 0.5
"""Extra time for a joint to rest beyond the rules' limits, for a busy computer, in seconds."""
LEASE_S: Final = 2.0
"""A silent neighbour counts as gone after this time (S05), in seconds."""
BRIDGE_S: Final = 1.0
"""Time for a bridge to return before the clients behind it count as gone (S05), in seconds."""
VALID_S: Final = 0.5
"""Validity of each set-point of a drill, in seconds."""

Motion = Literal["move", "stream"]
Failure = Literal["kill", "freeze", "hush", "unplug", "bus_off"]


class Scene(Struct, frozen=True, kw_only=True):
    """One failure during a motion."""

    name: str
    """Also the key of its limit in the robot file."""
    what: str
    """A description for people."""
    shows: str
    """The rule in docs/safety.md."""
    motion: Motion
    failure: Failure
    whom: Literal["caller", "driver", "gateway", "link", ""] = ""
    """The process that fails; empty: the simulated line."""
    noticed_s: float | None
    """Longest time until its detection, in seconds; None: the device's watchdog detects it."""

    def concerns(self, target: Target) -> bool:
        """Whether it can happen to a target on this bus."""
        return target.can if self.failure == "bus_off" else target.streams or self.motion != "stream"


SCENES: Final = (
    Scene(
        name="caller_killed",
        what="kill -9 of the caller",
        shows="S05",
        motion="move",
        failure="kill",
        whom="caller",
        noticed_s=0.0,
    ),
    Scene(
        name="caller_frozen",
        what="the caller freezes",
        shows="S05",
        motion="move",
        failure="freeze",
        whom="caller",
        noticed_s=LEASE_S,
    ),
    Scene(
        name="stream_frozen",
        what="the caller lives, but its set-points stop coming",
        shows="S04",
        motion="stream",
        failure="hush",
        whom="caller",
        noticed_s=VALID_S,
    ),
    Scene(
        name="gateway_killed",
        what="kill -9 of the robot's gateway",
        shows="S05",
        motion="move",
        failure="kill",
        whom="gateway",
        noticed_s=BRIDGE_S,
    ),
    Scene(
        name="partition",
        what="nothing passes between the robot's gateway and the caller's",
        shows="S05",
        motion="move",
        failure="freeze",
        whom="link",
        noticed_s=LEASE_S + BRIDGE_S,
    ),
    Scene(
        name="driver_killed",
        what="kill -9 of the driver",
        shows="S06",
        motion="move",
        failure="kill",
        whom="driver",
        noticed_s=None,
    ),
    Scene(
        name="driver_frozen",
        what="the driver freezes",
        shows="S06",
        motion="move",
        failure="freeze",
        whom="driver",
        noticed_s=None,
    ),
    Scene(
        name="unplug",
        what="serial and CAN adapters are unplugged, controllers leave the network",
        shows="S06",
        motion="move",
        failure="unplug",
        noticed_s=None,
    ),
    Scene(
        name="bus_off", what="CAN adapters go bus-off", shows="S06", motion="move", failure="bus_off", noticed_s=None
    ),
)


def limit_s(scene: Scene, target: Target, given: Drill) -> float:
    """How soon after the failure a joint must be at rest, in seconds: by the robot file, or by the rule."""
    given_s: float | None = getattr(given, scene.name)
    if given_s is not None:
        return given_s
    noticed_s = target.watchdog_s if scene.noticed_s is None else scene.noticed_s
    return noticed_s + target.brakes_s + ALLOWANCE_S
