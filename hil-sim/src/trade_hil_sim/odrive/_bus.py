"""A simulated CAN bus with ODrives, as a robot file describes it."""

import time
from collections.abc import Iterable, Sequence
from math import tau
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from trade_hil_sim._errors import SimulationError
from trade_hil_sim._log import ByteLog
from trade_hil_sim.can import CanBus

from ._axis import Axis
from ._names import odrive_label

if TYPE_CHECKING:
    from trade_drivers.robotfile import Bus, Joint
    from trade_drivers.robotfile import CanBus as CanRecord

__all__ = ["OdriveBus"]

LINES: Final = {"ODrive Pro": 4, "ODrive S1": 5, "ODrive Micro": 6}
"""Product lines by model."""


class OdriveBus(CanBus):
    """ODrives on one CAN bus; a client reaches them by the socketcand protocol, at `port`.

    Args:
        axes: on the bus.
        name: of the bus, in the log.
        channel: the interface clients open.
        bitrate: bits a second, if paced.
        log: where to record; default: a log in memory, at `log`.
        paced: let frames take as long as on a real wire.
        interface: a ``vcan`` of the system that the axes sit on, instead of a server of their own.
    """

    def __init__(
        self,
        axes: Iterable[Axis],
        *,
        name: str = "bus",
        channel: str = "can0",
        bitrate: int = 1_000_000,
        log: ByteLog | None = None,
        paced: bool = True,
        interface: str = "",
    ) -> None:
        super().__init__(
            axes,
            name=name,
            channel=channel,
            bitrate=bitrate,
            log=log,
            paced=paced,
            label=odrive_label,
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
    ) -> "OdriveBus":
        """The bus a robot file describes, each joint at its zero (or as near as its limits allow).

        The watchdogs of its axes are on and set to the bus's ``watchdog_s``.

        Args:
            bus: the bus's record.
            joints: the joints on it.
            port: not used; clients are given `port` instead.
            log: where to record.
            paced: take as long as the real wire.
            interface: a ``vcan`` of the system to sit on.

        Raises:
            SimulationError: a node there cannot be, or a model that is unknown.
        """
        if not hasattr(bus, "channel"):
            raise SimulationError(f"bus.{bus.name}: ODrives are on CAN; write interface and channel, not port")
        record = cast("CanRecord", bus)
        axes = [_axis_for(joint, bus.watchdog_s, time.monotonic()) for joint in joints]
        channel = record.channel.rpartition("/")[2] if record.interface == "socketcand" else "can0"
        return cls(
            axes,
            name=bus.name,
            channel=channel,
            bitrate=record.bitrate,
            log=log,
            paced=paced,
            interface=interface,
        )


def _axis_for(joint: "Joint", watchdog_s: float, t: float) -> Axis:
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
        watchdog_s=watchdog_s,
        t=t,
    )
