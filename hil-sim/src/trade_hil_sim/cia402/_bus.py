"""A simulated CAN bus with CiA 402 drives."""

from math import tau
from typing import TYPE_CHECKING

from trade_hil_sim.can import JointBus
from trade_hil_sim.faults._commands import SimulationError

from ._drive import Drive
from ._names import canopen_label

if TYPE_CHECKING:
    from trade_drivers.robotfile import CanBus, Joint

__all__ = ["Cia402Bus"]


class Cia402Bus(JointBus):
    """CiA 402 drives on one CAN bus; a client reaches them by the socketcand protocol, at `port`."""

    kind = "CiA 402 drives"
    label = staticmethod(canopen_label)

    @classmethod
    def device_for(cls, joint: "Joint", record: "CanBus", t: float) -> Drive:  # noqa: ARG003 - all is in the joint
        if not 1 <= joint.id <= 127:
            raise SimulationError(f'joint."{joint.name}".id: {joint.id} is no node id; there is 1 to 127')
        if joint.counts_per_rev is None:
            raise SimulationError(
                f'joint."{joint.name}".counts_per_rev: missing; a CiA 402 drive does not tell its counts'
            )
        angle_rad = max(joint.min_rad, min(joint.max_rad, 0.0))
        turns = (-1 if joint.reversed else 1) * (angle_rad - joint.offset_rad) / tau
        return Drive(
            joint.id,
            joint=joint.name,
            model=joint.model,
            counts_per_rev=joint.counts_per_rev,
            gear=joint.gear,
            position_counts=round(turns * joint.counts_per_rev * joint.gear),
            reversed_=joint.reversed,
            offset_rad=joint.offset_rad,
            t=t,
        )
