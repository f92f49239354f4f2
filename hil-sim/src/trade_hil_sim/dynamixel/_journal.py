"""What a Dynamixel bus writes into the log: instructions taken apart, and what servos do."""

from collections.abc import Sequence

from trade_hil_sim.log._byte_log import ByteLog, Entry

from ._protocol import BROADCAST, Instruction, Packet
from ._requests import Writing, readings, writings
from ._rules import MOTION
from ._servo import Servo

__all__ = ["Journal"]


class Journal:
    """Writes one bus's part of the log.

    Args:
        log: where to.
        bus: name of the bus.
        servos: on the bus; their indirect addresses tell what a write really touches.
    """

    def __init__(self, log: ByteLog, bus: str, servos: Sequence[Servo]) -> None:
        self._log, self._bus, self._servos = log, bus, servos

    def event(self, servo: Servo, name: str, t: float, detail: str) -> None:
        """A servo did something."""
        entry = Entry(
            t,
            self._bus,
            "event",
            name,
            servo.device_id,
            joint=servo.joint,
            position_counts=servo.counts(t),
            position_rad=servo.joint_rad(t),
            detail=detail,
        )
        self._log.add(entry)

    def refused(self, servo: Servo, t: float, reason: str) -> None:
        """A servo did not carry out an instruction."""
        self.event(servo, "refused", t, reason)

    def wrong_baud(self, t: float, baud: int | None) -> None:
        """No servo listens at the rate the client speaks."""
        rates = sorted({servo.baud for servo in self._servos})
        detail = f"the client speaks at {baud}, the devices listen at {rates}"
        self._log.add(Entry(t, self._bus, "event", "wrong_baud", detail=detail))

    def instruction(self, packet: Packet, t: float) -> None:
        """One instruction went over the bus; a group write makes one entry for each device."""
        if not packet.intact:
            name = f"damaged {packet.name}"
            self._log.add(Entry(t, self._bus, "instruction", name, packet.device_id, hex=packet.params.hex()))
        elif packet.instruction == Instruction.ACTION:
            self._action(packet, t)
        elif (wishes := writings(packet)) is not None:
            for wish in wishes:
                self._writing(packet.name, wish, t)
        else:
            self._other(packet, t)

    def _other(self, packet: Packet, t: float) -> None:
        wishes = readings(packet) or []
        ids = tuple(wish.device_id for wish in wishes) if packet.device_id == BROADCAST else ()
        address = wishes[0].address if wishes else None
        data = packet.params.hex()
        self._log.add(Entry(t, self._bus, "instruction", packet.name, packet.device_id, ids, hex=data, address=address))

    def _writing(self, name: str, wish: Writing, t: float) -> None:
        addressed = self._addressed(wish.device_id)
        servos = addressed or self._servos
        touched = (name for servo in servos for name in servo.table.touched(wish.address, len(wish.data)))
        registers = tuple(dict.fromkeys(touched))
        moves = bool(MOTION & set(registers))
        told = addressed[0] if moves and len(addressed) == 1 else None
        entry = Entry(
            t,
            self._bus,
            "instruction",
            name,
            wish.device_id,
            joint="" if told is None else told.joint,
            hex=wish.data.hex(),
            address=wish.address,
            registers=registers,
            moves=moves,
            position_counts=None if told is None else told.counts(t),
        )
        self._log.add(entry)

    def _action(self, packet: Packet, t: float) -> None:
        kept = [(servo, servo.registered) for servo in self._addressed(packet.device_id)]
        touched = (n for servo, write in kept if write for n in servo.table.touched(write[0], len(write[1])))
        registers = tuple(dict.fromkeys(touched))
        moves = bool(MOTION & set(registers))
        self._log.add(Entry(t, self._bus, "instruction", "action", packet.device_id, registers=registers, moves=moves))

    def _addressed(self, device_id: int) -> list[Servo]:
        return [s for s in self._servos if device_id in {BROADCAST, s.device_id, s.shadow_id}]
