"""A simulated Feetech bus: servos behind one serial line, with a log and scripted faults."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final

from trade_hil_sim.serial._device_bus import interleaved
from trade_hil_sim.serial._packets import BROADCAST, Writing
from trade_hil_sim.serial._servo_bus import ServoBus
from trade_robotfile import Joint

from ._protocol import Instruction, Packet, PacketReader, status
from ._servo import MOTION, Servo
from ._table import BAUDS, MODELS

ALWAYS_ANSWERED: Final = frozenset({Instruction.PING, Instruction.READ, Instruction.SYNC_READ})


class FeetechBus(ServoBus[Servo, Packet]):
    """Servos on one serial line; a client opens `port` as it would a real adapter.

    Args:
        devices: servos on the bus; two of one id answer on top of each other.
        port: stable path the client opens; made here, gone after `close`.
        name: of the bus, in the log.
        log: where to record; default: a log in memory, at `log`.
        paced: take the time of the real wire, return delays included; else answer as fast as possible.
        clock: the servos' clock, in seconds. The line itself keeps real time.
    """

    models, bauds, motion = MODELS, BAUDS, MOTION

    @classmethod
    def _new_servo(cls, joint: Joint, baud: int, position_counts: int, t: float) -> Servo:
        return Servo(
            joint.id,
            MODELS[joint.model],
            position_counts=position_counts,
            baud=baud,
            joint=joint.name,
            reversed_=joint.reversed,
            offset_rad=joint.offset_rad,
            t=t,
        )

    def _new_reader(self) -> PacketReader:
        return PacketReader()

    def _carry_out(self, servos: list[Servo], packet: Packet, t: float) -> None:
        if packet.instruction == Instruction.SYNC_READ:
            for wish in packet.readings():
                self._reply(_of(servos, wish.device_id), packet, lambda one, w=wish: one.read(w.address, w.length, t))
        elif packet.instruction == Instruction.SYNC_WRITE:
            for wish in packet.writings():
                for servo in _of(servos, wish.device_id):
                    servo.write(wish.address, wish.data, t)
        else:
            self._reply(_of(servos, packet.device_id), packet, lambda one: _obey(one, packet, t))

    def _reply(self, servos: Sequence[Servo], packet: Packet, act: Callable[[Servo], bytes | None]) -> None:
        """Let servos of one id carry it out and answer: one alone, or several at the same time."""
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

    def _note(self, packet: Packet, t: float) -> None:
        if packet.instruction != Instruction.ACTION:
            super()._note(packet, t)
            return
        for servo in self._addressed(packet.device_id):
            if servo.registered is not None:
                self._note_writing("action", Writing(servo.device_id, *servo.registered), t)


def _of(servos: Iterable[Servo], device_id: int) -> list[Servo]:
    return [servo for servo in servos if device_id in {BROADCAST, servo.device_id}]


def _unanswered(packet: Packet) -> bool:
    return packet.device_id == BROADCAST and packet.instruction not in {Instruction.PING, Instruction.SYNC_READ}


def _obey(servo: Servo, packet: Packet, t: float) -> bytes | None:
    """Carry a packet out; return the data of its answer, or None for an invalid packet, which gets no answer."""
    asked, wishes = packet.readings(), packet.writings()
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
