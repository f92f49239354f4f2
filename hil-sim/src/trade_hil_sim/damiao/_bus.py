"""A simulated CAN bus with Damiao motors."""

from typing import TYPE_CHECKING

from trade_hil_sim.can import JointBus
from trade_hil_sim.faults._commands import SimulationError

from ._motor import Motor
from ._names import damiao_label
from ._table import MASTER, MODELS

if TYPE_CHECKING:
    from trade_drivers.robotfile import CanBus, Joint

__all__ = ["DamiaoBus"]


class DamiaoBus(JointBus):
    """Damiao motors on one CAN bus; a client reaches them by the socketcand protocol, at `port`."""

    kind = "Damiao motors"
    label = staticmethod(damiao_label)

    @classmethod
    def device_for(cls, joint: "Joint", record: "CanBus", t: float) -> Motor:  # noqa: ARG003 - all is in the joint
        if not 1 <= joint.id < MASTER:
            raise SimulationError(f'joint."{joint.name}".id: {joint.id} is no identifier; there is 1 to 15')
        if joint.model not in MODELS:
            raise SimulationError(f'joint."{joint.name}".model: {joint.model!r} is none of {", ".join(MODELS)}')
        angle_rad = max(joint.min_rad, min(joint.max_rad, 0.0))
        return Motor(
            joint.id,
            joint=joint.name,
            model=joint.model,
            gear=joint.gear,
            position_rad=(-1 if joint.reversed else 1) * (angle_rad - joint.offset_rad) * joint.gear,
            reversed_=joint.reversed,
            offset_rad=joint.offset_rad,
            t=t,
        )
