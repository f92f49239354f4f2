"""The scenes of a drill: what is done to whom while something moves, and how soon it has to be at rest. Pure data."""

from typing import Final, Literal

from msgspec import Struct

from trade_drivers.robotfile import Drill
from trade_gateway.drill._targets import Target

__all__ = ["ALLOWANCE_S", "SCENES", "Deed", "Motion", "Scene", "limit_s"]

ALLOWANCE_S: Final = 0.5
"""For a busy computer: so much later than a rule alone would have it may a joint be at rest."""
LEASE_S: Final = 2.0
"""A silent neighbour is taken for gone after this (S05)."""
BRIDGE_S: Final = 1.0
"""Who is behind a bridge that goes is given so long to come back (S05)."""
VALID_S: Final = 0.5
"""How long each set-point of a drill holds."""

Motion = Literal["move", "stream"]
Deed = Literal["kill", "freeze", "hush", "unplug", "bus_off"]


class Scene(Struct, frozen=True, kw_only=True):
    """One thing that goes wrong."""

    name: str
    """Also the key of its limit in the robot file."""
    what: str
    """For people."""
    shows: str
    """The rule of docs/safety.md."""
    motion: Motion
    deed: Deed
    whom: Literal["caller", "driver", "gateway", "link", ""] = ""
    """A process of the stand; empty: the simulated line."""
    noticed_s: float | None
    """How late it is noticed at most; None: the device's watchdog notices."""

    def concerns(self, target: Target) -> bool:
        """Whether it can happen to what moves on this bus."""
        return target.can if self.deed == "bus_off" else target.streams or self.motion != "stream"


SCENES: Final = (
    Scene(
        name="caller_killed",
        what="kill -9 of the caller",
        shows="S05",
        motion="move",
        deed="kill",
        whom="caller",
        noticed_s=0.0,
    ),
    Scene(
        name="caller_frozen",
        what="the caller freezes",
        shows="S05",
        motion="move",
        deed="freeze",
        whom="caller",
        noticed_s=LEASE_S,
    ),
    Scene(
        name="stream_frozen",
        what="the caller lives, but its set-points stop coming",
        shows="S04",
        motion="stream",
        deed="hush",
        whom="caller",
        noticed_s=VALID_S,
    ),
    Scene(
        name="gateway_killed",
        what="kill -9 of the robot's gateway",
        shows="S05",
        motion="move",
        deed="kill",
        whom="gateway",
        noticed_s=BRIDGE_S,
    ),
    Scene(
        name="partition",
        what="nothing passes between the robot's gateway and the caller's",
        shows="S05",
        motion="move",
        deed="freeze",
        whom="link",
        noticed_s=LEASE_S + BRIDGE_S,
    ),
    Scene(
        name="driver_killed",
        what="kill -9 of the driver",
        shows="S06",
        motion="move",
        deed="kill",
        whom="driver",
        noticed_s=None,
    ),
    Scene(
        name="driver_frozen",
        what="the driver freezes",
        shows="S06",
        motion="move",
        deed="freeze",
        whom="driver",
        noticed_s=None,
    ),
    Scene(
        name="unplug",
        what="serial and CAN adapters are unplugged, controllers leave the network",
        shows="S06",
        motion="move",
        deed="unplug",
        noticed_s=None,
    ),
    Scene(name="bus_off", what="CAN adapters go bus-off", shows="S06", motion="move", deed="bus_off", noticed_s=None),
)


def limit_s(scene: Scene, target: Target, given: Drill) -> float:
    """How soon after the deed a joint has to be at rest, in seconds: what the robot file says, or the rule does."""
    told: float | None = getattr(given, scene.name)
    if told is not None:
        return told
    noticed_s = target.watchdog_s if scene.noticed_s is None else scene.noticed_s
    return noticed_s + target.brakes_s + ALLOWANCE_S
