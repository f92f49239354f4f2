"""A simulated CAN bus with CiA 402 drives."""

from math import tau
from typing import Final

from trade_hil_sim.can import Frame, JointBus
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.mechanics._device import start_rad
from trade_robotfile import CanBus, Joint

from ._drive import FIRMWARE, Drive

NODES: Final = 0x80
FUNCTIONS: Final = {
    0x180: "tpdo1",
    0x200: "rpdo1",
    0x280: "tpdo2",
    0x300: "rpdo2",
    0x380: "tpdo3",
    0x400: "rpdo3",
    0x480: "tpdo4",
    0x500: "rpdo4",
    0x580: "sdo_reply",
    0x600: "sdo_request",
    0x700: "heartbeat",
}
"""What a frame is, by its id: the predefined connection set (CiA 301, 7.3.5)."""


class Cia402Bus(JointBus):
    """CiA 402 drives on one CAN bus; a client reaches them by the socketcand protocol, at `port`."""

    kind = "CiA 402 drives"

    @staticmethod
    def label(frame: Frame) -> tuple[str, int | None]:
        """Name of a frame, and the node it comes from or goes to."""
        if frame.extended:
            return "", None
        node, function = frame.can_id & NODES - 1, frame.can_id & ~(NODES - 1)
        match function:
            case 0x000 if node == 0:
                return "nmt", frame.data[1] or None if len(frame.data) > 1 else None
            case 0x080:
                return ("emcy", node) if node else ("sync", None)
            case _ if node and function in FUNCTIONS:
                boots = function == 0x700 and frame.data == b"\0"
                return "boot_up" if boots else FUNCTIONS[function], node
            case _:
                return "", None

    @classmethod
    def device_for(cls, joint: Joint, record: CanBus, t: float) -> Drive:  # noqa: ARG003 - all is in the joint
        if not 1 <= joint.id <= 127:
            raise SimulationError(f'joint."{joint.name}".id: {joint.id} is no node id; there is 1 to 127')
        if joint.counts_per_rev is None:
            raise SimulationError(
                f'joint."{joint.name}".counts_per_rev: missing; a CiA 402 drive does not report its counts'
            )
        return Drive(
            joint.id,
            joint=joint.name,
            model=joint.model,
            firmware=joint.firmware or FIRMWARE,
            serial_number=joint.serial_number or 0,
            counts_per_rev=joint.counts_per_rev,
            gear=joint.gear,
            position_counts=round(start_rad(joint) / tau * joint.counts_per_rev * joint.gear),
            reversed_=joint.reversed,
            offset_rad=joint.offset_rad,
            t=t,
        )
