"""A simulated Dynamixel bus: servos behind one serial line, with a log and scripted faults."""

from functools import cached_property

from trade_hil_sim.log._byte_log import LogEntry
from trade_hil_sim.serial._packets import BROADCAST, Writing
from trade_hil_sim.serial._servo_bus import ServoBus
from trade_robotfile import Joint

from ._dispatch import Dispatch
from ._memory import MOTION
from ._models import MODELS
from ._protocol import Instruction, Packet, PacketReader
from ._servo import Servo
from ._table import BAUDS


class DynamixelBus(ServoBus[Servo, Packet]):
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

    @cached_property
    def _dispatch(self) -> Dispatch:
        return Dispatch(self._faults.silences)

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
        if packet.intact:
            for servo in servos:
                servo.heard(t)
        for answer in self._dispatch.answers(servos, packet, t):
            device_id = answer.ids[0] if len(answer.ids) == 1 else BROADCAST
            self._answer(answer.data, answer.ids, packet.name, after_s=answer.delay_s, device_id=device_id)

    def _note(self, packet: Packet, t: float) -> None:
        if not packet.intact:
            name = f"damaged {packet.name}"
            self.log.add(LogEntry(t, self.name, "instruction", name, packet.device_id, hex=packet.params.hex()))
        elif packet.instruction == Instruction.ACTION:
            self._note_action(packet, t)
        else:
            super()._note(packet, t)

    def _note_action(self, packet: Packet, t: float) -> None:
        kept = [(servo, servo.registered) for servo in self._addressed(packet.device_id)]
        registers = self._touched((servo, Writing(servo.device_id, *write)) for servo, write in kept if write)
        moves = bool(MOTION & set(registers))
        self.log.add(
            LogEntry(t, self.name, "instruction", "action", packet.device_id, registers=registers, moves=moves)
        )
