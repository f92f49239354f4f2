"""A simulated CAN bus with Damiao motors."""

from trade_hil_sim.can import Frame, JointBus
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.mechanics._device import start_rad
from trade_robotfile import CanBus, Joint

from . import _table as table
from ._motor import SOFTWARE, Motor
from ._table import MASTER, MODELS


class DamiaoBus(JointBus):
    """Damiao motors on one CAN bus; a client reaches them by the socketcand protocol, at `port`."""

    kind = "Damiao motors"

    @staticmethod
    def label(frame: Frame) -> tuple[str, int | None]:
        """Name of a frame, and its motor, if answers have the ids that the vendor's tool sets."""
        data = frame.data
        if frame.extended or frame.remote:
            return "", None
        if frame.can_id == table.BROADCAST:
            return (table.QUESTIONS.get(data[2], ""), data[0]) if len(data) > 3 else ("", None)
        base, motor = frame.can_id & 0x700, frame.can_id & 0xFF
        if base in table.TARGETS:
            return table.TARGETS[base], motor
        if base:
            return "", None
        if motor < table.MASTER:
            return (table.ORDERS.get(data[7], "mit") if data[:7] == b"\xff" * 7 and len(data) == 8 else "mit"), motor
        about = data[:2] == bytes((motor - table.MASTER, 0)) and data[2:3] in {
            bytes((table.READ,)),
            bytes((table.WRITE,)),
        }
        return ("register" if about else "feedback"), motor - table.MASTER

    @classmethod
    def device_for(cls, joint: Joint, record: CanBus, t: float) -> Motor:  # noqa: ARG003 - all is in the joint
        if not 1 <= joint.id < MASTER:
            raise SimulationError(f'joint."{joint.name}".id: {joint.id} is no identifier; there is 1 to 15')
        if joint.model not in MODELS:
            raise SimulationError(f'joint."{joint.name}".model: {joint.model!r} is none of {", ".join(MODELS)}')
        return Motor(
            joint.id,
            joint=joint.name,
            model=joint.model,
            software=_software(joint),
            gear=joint.gear,
            position_rad=start_rad(joint) * joint.gear,
            reversed_=joint.reversed,
            offset_rad=joint.offset_rad,
            t=t,
        )


def _software(joint: Joint) -> int:
    if joint.firmware is None:
        return SOFTWARE
    if not joint.firmware.isdecimal():
        raise SimulationError(f'joint."{joint.name}".firmware: {joint.firmware!r} is no number, such as {SOFTWARE}')
    return int(joint.firmware)
