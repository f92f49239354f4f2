"""A simulated Feetech bus: servos behind one serial line, with a log and scripted faults."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog, Entry
from trade_hil_sim.serial._device_bus import DeviceLine, interleaved

from ._protocol import BROADCAST, Instruction, Packet, PacketReader, Writing, readings, status, writings
from ._servo import MOTION, Servo
from ._table import BAUDS, CENTRE, RAD_PER_COUNT, STS3215

if TYPE_CHECKING:
    from trade_drivers.robotfile import Joint, SerialBus

__all__ = ["FeetechBus"]

PAUSE_S: Final = 0.1
"""A packet whose next byte has not come after this long is given up."""
ALWAYS_ANSWERED: Final = frozenset({Instruction.PING, Instruction.READ, Instruction.SYNC_READ})


class FeetechBus(DeviceLine[Servo]):
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
        self._reader = PacketReader()
        self._deaf_to: int | None = None
        for servo in self._devices:
            servo.emit = self._event

    @classmethod
    def from_robot(
        cls, bus: "SerialBus", joints: "Sequence[Joint]", port: Path, *, log: ByteLog | None = None, paced: bool = True
    ) -> "FeetechBus":
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
        match command:
            case faults.Absent():
                device.absent = command.on
            case faults.Freeze(tick=False):
                device.freeze_sensor(command.on, t)
            case faults.Jam():
                device.jam(command.on, t)
            case faults.WrongModel():
                device.memory.set("model_number", command.number)
            case faults.BrownOut():
                device.reboot(t, "brown_out")
            case faults.HardwareFault():
                device.fail(command.bits, t)
            case faults.Supply():
                device.set_supply(t, voltage_v=command.voltage_v, temperature_c=command.temperature_c)
            case faults.Place():
                device.place(command.counts, t)
            case _:
                raise SimulationError(f"{command} is nothing that happens to an {device.model.name}")

    def _heal(self, device: Servo, t: float) -> None:
        device.absent = False
        device.freeze_sensor(False, t)
        device.jam(False, t)
        device.memory.set("model_number", device.model.number)

    # --- packets

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
            rates = sorted({servo.baud for servo in self._devices})
            detail = f"the client speaks at {baud}, the devices listen at {rates}"
            self.log.add(Entry(t, self.name, "event", "wrong_baud", detail=detail))
            self._reader.reset()
        return hearing

    def _carry_out(self, servos: list[Servo], packet: Packet, t: float) -> None:
        now = self._clock()
        self._note(packet, t)
        if packet.instruction == Instruction.SYNC_READ:
            for wish in readings(packet):
                self._reply(_of(servos, wish.device_id), packet, lambda one, w=wish: one.read(w.address, w.length, now))
        elif packet.instruction == Instruction.SYNC_WRITE:
            for wish in writings(packet):
                for servo in _of(servos, wish.device_id):
                    servo.write(wish.address, wish.data, now)
        else:
            self._reply(_of(servos, packet.device_id), packet, lambda one: _obey(one, packet, now))

    def _reply(self, servos: Sequence[Servo], packet: Packet, act: Callable[[Servo], bytes | None]) -> None:
        """Have servos of one id do it and answer: one of them, or several on top of each other."""
        answers: list[bytes] = []
        delay_s = 0.0
        device_id = packet.device_id
        for servo in servos:
            device_id, delay_s = servo.device_id, servo.return_delay_s
            complaints, params = servo.status, act(servo)
            wanted = servo.answers_all or packet.instruction in ALWAYS_ANSWERED
            silenced = self._faults.silences(device_id, packet.name)
            if params is not None and wanted and not silenced and not _unanswered(packet):
                answers.append(status(device_id, complaints, params))
        if answers:
            data = answers[0] if len(answers) == 1 else interleaved(answers)
            self._answer(data, (device_id,), packet.name, after_s=delay_s, device_id=device_id)

    # --- the log

    def _note(self, packet: Packet, t: float) -> None:
        """One instruction went over the bus; a group write makes one entry for each device."""
        if packet.instruction == Instruction.ACTION:
            kept = [(servo.device_id, write) for servo in self._devices if (write := servo.registered) is not None]
            for device_id, (address, data) in kept:
                if packet.device_id in {BROADCAST, device_id}:
                    self._note_write("action", Writing(device_id, address, data), t)
        elif wishes := writings(packet):
            for wish in wishes:
                self._note_write(packet.name, wish, t)
        else:
            asked = readings(packet)
            ids = tuple(wish.device_id for wish in asked) if packet.device_id == BROADCAST else ()
            address = asked[0].address if asked else None
            data = packet.params.hex()
            self.log.add(
                Entry(t, self.name, "instruction", packet.name, packet.device_id, ids, hex=data, address=address)
            )

    def _note_write(self, name: str, wish: Writing, t: float) -> None:
        registers = self._devices[0].memory.touched(wish.address, len(wish.data))
        self.log.add(
            Entry(
                t,
                self.name,
                "instruction",
                name,
                wish.device_id,
                hex=wish.data.hex(),
                address=wish.address,
                registers=registers,
                moves=bool(MOTION & set(registers)),
            )
        )

    def _event(self, servo: Servo, name: str, t: float, detail: str) -> None:
        self.log.add(
            Entry(
                t,
                self.name,
                "event",
                name,
                servo.device_id,
                joint=servo.joint,
                position_counts=servo.counts(t),
                position_rad=servo.joint_rad(t),
                detail=detail,
            )
        )


def _of(servos: Iterable[Servo], device_id: int) -> list[Servo]:
    return [servo for servo in servos if device_id in {BROADCAST, servo.device_id}]


def _unanswered(packet: Packet) -> bool:
    return packet.device_id == BROADCAST and packet.instruction not in {Instruction.PING, Instruction.SYNC_READ}


def _obey(servo: Servo, packet: Packet, t: float) -> bytes | None:
    """Carry a packet out; the data of its answer, or None for one that is not answered: it makes no sense."""
    asked, wishes = readings(packet), writings(packet)
    match packet.instruction:
        case Instruction.READ if asked:
            return servo.read(asked[0].address, asked[0].length, t)
        case Instruction.WRITE if wishes:
            servo.write(wishes[0].address, wishes[0].data, t)
        case Instruction.REG_WRITE if wishes:
            servo.reg_write(wishes[0].address, wishes[0].data)
        case Instruction.ACTION:
            servo.action(t)
        case Instruction.FACTORY_RESET:
            servo.factory_reset(t)
        case Instruction.REBOOT:
            servo.reboot(t)
        case Instruction.PING:
            servo.advance(t)
        case _:
            return None
    return b""


def _servo_for(bus: "SerialBus", joint: "Joint", t: float) -> Servo:
    if joint.model != STS3215.name:
        raise SimulationError(f'joint."{joint.name}".model: {joint.model!r} is not simulated; there is {STS3215.name}')
    if bus.baud not in BAUDS:
        known = ", ".join(map(str, sorted(BAUDS)))
        raise SimulationError(f"bus.{bus.name}.baud: {bus.baud} is no rate of an {STS3215.name}; there is {known}")
    angle_rad = max(joint.min_rad, min(joint.max_rad, 0.0))
    sign = -1 if joint.reversed else 1
    return Servo(
        joint.id,
        position_counts=CENTRE + round(sign * (angle_rad - joint.offset_rad) / RAD_PER_COUNT),
        baud=bus.baud,
        joint=joint.name,
        reversed_=joint.reversed,
        offset_rad=joint.offset_rad,
        t=t,
    )
