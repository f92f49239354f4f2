"""A simulated CAN bus with Damiao motors, as a robot file describes it."""

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from trade_hil_sim._errors import SimulationError
from trade_hil_sim._log import ByteLog
from trade_hil_sim.can import CanBus

from ._motor import Motor
from ._names import damiao_label
from ._table import MASTER, MODELS

if TYPE_CHECKING:
    from trade_drivers.robotfile import Bus, Joint
    from trade_drivers.robotfile import CanBus as CanRecord

__all__ = ["DamiaoBus"]


class DamiaoBus(CanBus):
    """Damiao motors on one CAN bus; a client reaches them by the socketcand protocol, at `port`.

    Args:
        motors: on the bus.
        name: of the bus, in the log.
        channel: the interface clients open.
        bitrate: bits a second, if paced.
        log: where to record; default: a log in memory, at `log`.
        paced: let frames take as long as on a real wire.
        interface: a ``vcan`` of the system that the motors sit on, instead of a server of their own.
    """

    def __init__(
        self,
        motors: Iterable[Motor],
        *,
        name: str = "bus",
        channel: str = "can0",
        bitrate: int = 1_000_000,
        log: ByteLog | None = None,
        paced: bool = True,
        interface: str = "",
    ) -> None:
        super().__init__(
            motors,
            name=name,
            channel=channel,
            bitrate=bitrate,
            log=log,
            paced=paced,
            label=damiao_label,
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
    ) -> "DamiaoBus":
        """The bus a robot file describes, each joint at its zero (or as near as its limits allow).

        Args:
            bus: the bus's record.
            joints: the joints on it.
            port: not used; clients are given `port` instead.
            log: where to record.
            paced: take as long as the real wire.
            interface: a ``vcan`` of the system to sit on.

        Raises:
            SimulationError: an identifier there cannot be, or a model that is unknown.
        """
        if not hasattr(bus, "channel"):
            raise SimulationError(f"bus.{bus.name}: Damiao motors are on CAN; write interface and channel, not port")
        record = cast("CanRecord", bus)
        motors = [_motor_for(joint, time.monotonic()) for joint in joints]
        channel = record.channel.rpartition("/")[2] if record.interface == "socketcand" else "can0"
        return cls(
            motors,
            name=bus.name,
            channel=channel,
            bitrate=record.bitrate,
            log=log,
            paced=paced,
            interface=interface,
        )


def _motor_for(joint: "Joint", t: float) -> Motor:
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
