"""A simulated CAN bus with one vendor's devices on it, as a robot file describes it."""

import time
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog
from trade_robotfile import Bus, Joint
from trade_robotfile import CanBus as CanRecord

from ._bus import CanBus
from ._device import Device

if TYPE_CHECKING:
    from typing_extensions import Self


class JointBus(CanBus):
    """Devices that each move one joint."""

    kind: ClassVar[str]
    """The kind of devices, in messages: ``ODrives``."""

    @classmethod
    @abstractmethod
    def device_for(cls, joint: Joint, record: CanRecord, t: float) -> Device:
        """The device of a joint, as near to its zero as its limits allow; raises SimulationError if it is invalid."""

    @classmethod
    def from_robot(
        cls,
        bus: Bus,
        joints: Sequence[Joint],
        port: Path,  # noqa: ARG003 - a CAN bus is no path; its port is known when it is open
        *,
        log: ByteLog | None = None,
        paced: bool = True,
        interface: str = "",
    ) -> "Self":
        """The bus a robot file describes, each joint at its zero (or as near as its limits allow).

        Args:
            bus: the bus's record.
            joints: the joints on it.
            port: not used; clients open the property `port` instead.
            log: where to record.
            paced: take the time of the real wire.
            interface: a ``vcan`` of the system to use.

        Raises:
            SimulationError: an id or a model that is not possible, or a missing key.
        """
        if not isinstance(bus, CanRecord):
            raise SimulationError(f"bus.{bus.name}: {cls.kind} are on CAN; write interface and channel, not port")
        return cls(
            [cls.device_for(joint, bus, time.monotonic()) for joint in joints],
            name=bus.name,
            channel=bus.channel.rpartition("/")[2] if bus.interface == "socketcand" else "can0",
            bitrate=bus.bitrate,
            log=log,
            paced=paced,
            interface=interface,
        )
