"""A simulated CAN bus with ODrives; their watchdogs are on, and set to the watchdog_s of the bus."""

from math import tau
from typing import TYPE_CHECKING, Final

from trade_hil_sim.can import JointBus
from trade_hil_sim.faults._commands import SimulationError

from ._axis import Axis
from ._names import odrive_label

if TYPE_CHECKING:
    from trade_drivers.robotfile import CanBus, Joint

__all__ = ["OdriveBus"]

LINES: Final = {"ODrive Pro": 4, "ODrive S1": 5, "ODrive Micro": 6}
"""Product lines by model."""


class OdriveBus(JointBus):
    """ODrives on one CAN bus; a client reaches them by the socketcand protocol, at `port`."""

    kind = "ODrives"
    label = staticmethod(odrive_label)

    @classmethod
    def device_for(cls, joint: "Joint", record: "CanBus", t: float) -> Axis:
        if not 0 <= joint.id < 63:
            raise SimulationError(f'joint."{joint.name}".id: {joint.id} is no node; there is 0 to 62')
        if joint.model not in LINES:
            raise SimulationError(f'joint."{joint.name}".model: {joint.model!r} is none of {", ".join(LINES)}')
        angle_rad = max(joint.min_rad, min(joint.max_rad, 0.0))
        turns = (-1 if joint.reversed else 1) * (angle_rad - joint.offset_rad) * joint.gear / tau
        return Axis(
            joint.id,
            joint=joint.name,
            model=joint.model,
            line=LINES[joint.model],
            gear=joint.gear,
            turns=turns,
            reversed_=joint.reversed,
            offset_rad=joint.offset_rad,
            watchdog_s=record.watchdog_s,
            t=t,
        )
