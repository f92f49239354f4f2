"""A simulated CAN bus with ODrives; their watchdogs are on, and set to the watchdog_s of the bus."""

from math import tau
from typing import Final

from trade_hil_sim.can import Frame, JointBus
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.mechanics._device import start_rad, version_of
from trade_robotfile import CanBus, Joint

from ._axis import FIRMWARE, Axis
from ._table import ANSWERS, Command

LINES: Final = {"ODrive Pro": 4, "ODrive S1": 5, "ODrive Micro": 6}
"""Product lines by model."""
_KNOWN: Final = {int(command): command for command in Command}


class OdriveBus(JointBus):
    """ODrives on one CAN bus; a client reaches them by the socketcand protocol, at `port`."""

    kind = "ODrives"

    @staticmethod
    def label(frame: Frame) -> tuple[str, int | None]:
        """Name of a frame, and its node; a request is named after its answer: ``ask_get_iq``."""
        if frame.extended:
            return "", None
        command, node = _KNOWN.get(frame.can_id & 0x1F), frame.can_id >> 5
        if command is None:
            return "", node
        asks = command in ANSWERS and (frame.remote or not frame.data)
        return f"ask_{command.name.lower()}" if asks else command.name.lower(), node

    @classmethod
    def device_for(cls, joint: Joint, record: CanBus, t: float) -> Axis:
        if not 0 <= joint.id < 63:
            raise SimulationError(f'joint."{joint.name}".id: {joint.id} is no node; there is 0 to 62')
        if joint.model not in LINES:
            raise SimulationError(f'joint."{joint.name}".model: {joint.model!r} is none of {", ".join(LINES)}')
        return Axis(
            joint.id,
            joint=joint.name,
            model=joint.model,
            line=LINES[joint.model],
            firmware=FIRMWARE if joint.firmware is None else version_of(joint, len(FIRMWARE)),
            gear=joint.gear,
            turns=start_rad(joint) * joint.gear / tau,
            reversed_=joint.reversed,
            offset_rad=joint.offset_rad,
            watchdog_s=record.watchdog_s,
            t=t,
        )
