"""A simulated Dynamixel bus: servos behind one serial line, with a log and scripted faults."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog
from trade_hil_sim.serial._device_bus import DeviceLine

from ._dispatch import Dispatch
from ._journal import Journal
from ._models import MODELS
from ._protocol import BROADCAST, Packet, PacketReader
from ._servo import Servo
from ._table import BAUDS, CENTRE, RAD_PER_COUNT

if TYPE_CHECKING:
    from trade_drivers.robotfile import Joint, SerialBus

__all__ = ["DynamixelBus"]

PAUSE_S: Final = 0.1
"""A packet whose next byte has not come after this long is given up."""


class DynamixelBus(DeviceLine[Servo]):
    """Servos on one serial line; a client opens `port` as it would a real adapter.

    Args:
        servos: on the bus; two of one id answer on top of each other.
        port: stable path the client opens; made here, gone after `close`.
        name: of the bus, in the log.
        log: where to record; default: a log in memory, at `log`.
        paced: take as long as the real wire, return delays included; else answer as fast as possible.
        clock: the servos' clock, in seconds. The line itself keeps real time.
    """

    def __init__(
        self,
        servos: Iterable[Servo],
        port: Path,
        *,
        name: str = "bus",
        log: ByteLog | None = None,
        paced: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(servos, port, name=name, log=log, paced=paced, clock=clock)
        self._journal = Journal(self.log, name, self._devices)
        self._dispatch = Dispatch(self._faults.silences, self._journal.refused)
        self._reader = PacketReader()
        self._deaf_to: int | None = None
        for servo in self._devices:
            servo.emit = self._journal.event

    @classmethod
    def from_robot(
        cls, bus: "SerialBus", joints: "Sequence[Joint]", port: Path, *, log: ByteLog | None = None, paced: bool = True
    ) -> "DynamixelBus":
        """The bus a robot file describes, each joint at its zero (or as near as its limits allow).

        Args:
            bus: the bus's record.
            joints: the joints on it.
            port: path the client will open instead of the record's.
            log: where to record.
            paced: take as long as the real wire.

        Raises:
            SimulationError: a model or baud rate that is not simulated.
        """
        clock = time.monotonic
        servos = [_servo_for(bus, joint, clock()) for joint in joints]
        return cls(servos, port, name=bus.name, log=log, paced=paced, clock=clock)

    def _do_to(self, device: Servo, command: faults.Command, t: float) -> None:
        _do_to(device, command, t)

    def _heal(self, device: Servo, t: float) -> None:
        device.absent = False
        device.freeze_sensor(False, t)
        device.jam(False, t)
        device.table.set("model_number", device.model.number)

    def _silent_for(self, s: float) -> None:
        if s > PAUSE_S:
            self._reader.reset()

    def _take(self, data: bytes, t: float) -> None:
        hearing = self._hearing(t)
        for packet in self._reader.feed(data) if hearing else ():
            self._carry_out([servo for servo in hearing if servo.hears], packet, t)

    def _hearing(self, t: float) -> list[Servo]:
        """Servos set to the baud rate the client speaks at; to others it is noise."""
        baud = self._line.client_baud
        hearing = [servo for servo in self._devices if baud is None or servo.baud == baud]
        if hearing:
            self._deaf_to = None
        elif baud != self._deaf_to:
            self._deaf_to = baud
            self._journal.wrong_baud(t, baud)
            self._reader.reset()
        return hearing

    def _carry_out(self, servos: list[Servo], packet: Packet, t: float) -> None:
        now = self._clock()
        self._journal.instruction(packet, t)
        if packet.intact:
            for servo in servos:
                servo.heard(now)
        for answer in self._dispatch.answers(servos, packet, now):
            device_id = answer.ids[0] if len(answer.ids) == 1 else BROADCAST
            self._answer(answer.data, answer.ids, packet.name, after_s=answer.delay_s, device_id=device_id)


def _servo_for(bus: "SerialBus", joint: "Joint", t: float) -> Servo:
    model = MODELS.get(joint.model)
    if model is None:
        known = ", ".join(sorted(MODELS))
        raise SimulationError(f'joint."{joint.name}".model: {joint.model!r} is not simulated; there is {known}')
    if bus.baud not in BAUDS:
        known = ", ".join(str(baud) for baud in BAUDS)
        raise SimulationError(f"bus.{bus.name}.baud: {bus.baud} is no rate of a {model.name}; there is {known}")
    angle_rad = max(joint.min_rad, min(joint.max_rad, 0.0))
    sign = -1 if joint.reversed else 1
    counts = CENTRE + round(sign * (angle_rad - joint.offset_rad) / RAD_PER_COUNT)
    return Servo(
        joint.id,
        model,
        position_counts=counts,
        baud=bus.baud,
        joint=joint.name,
        reversed_=joint.reversed,
        offset_rad=joint.offset_rad,
        t=t,
    )


def _do_to(servo: Servo, command: faults.Command, t: float) -> None:
    match command:
        case faults.Absent():
            servo.absent = command.on
        case faults.Freeze():
            servo.freeze_sensor(command.on, t, tick=command.tick)
        case faults.Jam():
            servo.jam(command.on, t)
        case faults.WrongModel():
            servo.table.set("model_number", command.number)
        case faults.BrownOut():
            servo.reboot(t, "brown_out")
        case faults.HardwareFault():
            servo.fail(command.bits, t)
        case faults.Supply():
            servo.set_supply(t, voltage_v=command.voltage_v, temperature_c=command.temperature_c)
        case faults.Place():
            servo.place(command.counts, t)
        case _:
            raise SimulationError(f"{command} is not for one device")
