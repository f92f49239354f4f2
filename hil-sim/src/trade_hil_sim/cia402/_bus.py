"""A simulated CAN bus with CiA 402 drives, as a robot file describes it."""

import time
from collections.abc import Iterable, Sequence
from math import tau
from pathlib import Path
from typing import TYPE_CHECKING, cast

from trade_hil_sim._errors import SimulationError
from trade_hil_sim._log import ByteLog
from trade_hil_sim.can import CanBus

from ._drive import Drive
from ._names import canopen_label

if TYPE_CHECKING:
    from trade_drivers.robotfile import Bus, Joint
    from trade_drivers.robotfile import CanBus as CanRecord

__all__ = ["Cia402Bus"]


class Cia402Bus(CanBus):
    """Drives on one CAN bus; a client reaches them by the socketcand protocol, at `port`.

    Args:
        drives: on the bus.
        name: of the bus, in the log.
        channel: the interface clients open.
        bitrate: bits a second, if paced.
        log: where to record; default: a log in memory, at `log`.
        paced: let frames take as long as on a real wire.
        interface: a ``vcan`` of the system that the drives sit on, instead of a server of their own.
    """

    def __init__(
        self,
        drives: Iterable[Drive],
        *,
        name: str = "bus",
        channel: str = "can0",
        bitrate: int = 1_000_000,
        log: ByteLog | None = None,
        paced: bool = True,
        interface: str = "",
    ) -> None:
        super().__init__(
            drives,
            name=name,
            channel=channel,
            bitrate=bitrate,
            log=log,
            paced=paced,
            label=canopen_label,
            interface=interface,
        )

    @classmethod
    def from_robot(
        cls,
        bus: "Bus",
        joints: "Sequence[Joint]",
        port: Path,  # noqa: ARG003 - a CAN bus is no path; its port is known when it is open
        *,
        log: ByteLog | None = None,
        paced: bool = True,
        interface: str = "",
    ) -> "Cia402Bus":
        """The bus a robot file describes, each joint at its zero (or as near as its limits allow).

        Args:
            bus: the bus's record.
            joints: the joints on it.
            port: not used; clients are given `port` instead.
            log: where to record.
            paced: take as long as the real wire.
            interface: a ``vcan`` of the system to sit on.

        Raises:
            SimulationError: a node id there cannot be, or a joint that does not tell its counts.
        """
        if not hasattr(bus, "channel"):
            raise SimulationError(f"bus.{bus.name}: CiA 402 drives are on CAN; write interface and channel, not port")
        record = cast("CanRecord", bus)
        drives = [_drive_for(joint, time.monotonic()) for joint in joints]
        channel = record.channel.rpartition("/")[2] if record.interface == "socketcand" else "can0"
        return cls(
            drives,
            name=bus.name,
            channel=channel,
            bitrate=record.bitrate,
            log=log,
            paced=paced,
            interface=interface,
        )


def _drive_for(joint: "Joint", t: float) -> Drive:
    if not 1 <= joint.id <= 127:
        raise SimulationError(f'joint."{joint.name}".id: {joint.id} is no node id; there is 1 to 127')
    if joint.counts_per_rev is None:
        raise SimulationError(f'joint."{joint.name}".counts_per_rev: missing; a CiA 402 drive does not tell its counts')
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
